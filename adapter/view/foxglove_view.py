"""The run over Foxglove's WebSocket protocol, for Foxglove, Lichtblick, PlotJuggler and the like.

Every topic is a ROS 2 message (CDR, with its definition beside it), the only encoding that all of
them plot; Foxglove's own library (extra `live`) does the rest: who is slow loses the oldest
messages.

    /joint_states             sensor_msgs/JointState     q, dq, tau of the filtered state
    /residuals                sensor_msgs/JointState     effort: what the estimate does not explain
    /residual_noise           sensor_msgs/JointState     effort: its standard deviation so far
    /external_torques         sensor_msgs/JointState     effort: what the surroundings push with
    /state                    std_msgs/String            the headline, where it changes

and, as a recording has them, all that `adapter.realtime.run_messages` tells: a layout that
somebody made for the one serves the other.
"""

from __future__ import annotations

import importlib.util
import socket
from collections.abc import Iterator
from typing import Any

import numpy as np

from adapter.errors import MeansError, UsageError
from adapter.model.spatial import Array
from adapter.realtime import run_messages
from adapter.realtime.run_messages import RunMessages, ShownArm
from adapter.view.now import KnownRun, Now
from adapter.view.server import HOST
from drivers.files.estimates import EstimateNames
from drivers.files.mcap.writer import EXTERNAL_TORQUES
from drivers.files.messages import Message, encode, header
from drivers.files.ros_types import JOINT_STATE, STRING, schemas

NONE: Array = np.zeros(0)
TOPICS = {
    **dict.fromkeys(
        ("/joint_states", "/residuals", "/residual_noise", EXTERNAL_TORQUES), JOINT_STATE
    ),
    "/state": STRING,
    **run_messages.TOPICS,
}


def need_foxglove() -> None:
    """Raises MeansError where Foxglove's library is missing."""
    if importlib.util.find_spec("foxglove") is None:
        raise MeansError("--foxglove needs foxglove-sdk: pip install 'panda-adapter[live]'")


def free_port(port: int) -> int:
    """The port, or any free one for 0. Raises UsageError where it is taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise UsageError(
                f"nothing can be served to Foxglove on port {port} ({error.strerror}); choose "
                "another: --foxglove PORT, or --foxglove 0 for any that is free"
            ) from None
        return int(probe.getsockname()[1])


class FoxgloveView:
    """Serves and feeds them; stamps are the arm's own.

    Args:
        known: the run.
        port: on this machine.

    Raises:
        MeansError: the port is taken, or the library is missing.
    """

    def __init__(self, known: KnownRun, port: int) -> None:
        need_foxglove()
        import foxglove

        tree = known.documented.tree
        names = EstimateNames(tree.joint_names, tree.body_names, known.effects)
        self._names, self._messages = names, RunMessages(names, ShownArm.of(known.documented))
        self._context = context = foxglove.Context()  # channels end with it
        self._channels: dict[str, Any] = {}
        for topic, name in TOPICS.items():
            data = schemas()[name].encode()
            schema = foxglove.Schema(name=name, encoding="ros2msg", data=data)
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=context
            )
        try:
            self._server = foxglove.start_server(
                name=f"panda-adapter, {known.documented.name}",
                host=HOST,
                port=port,
                context=context,
                session_id=known.key or None,
                message_backlog_size=64,  # messages that wait for a slow client; then the oldest go
            )
        except (RuntimeError, OSError) as error:
            raise MeansError(f"nothing can be served on port {port}: {error}") from None
        self._described_s, self._headline = -np.inf, ""

    def __call__(self, now: Now) -> None:
        """Take what is to be seen now; waits for nobody."""
        for message in self._due(now):
            data = encode(message.schema, message.fields)
            self._channels[message.topic].log(data, log_time=max(message.stamp_ns, 0))
        if now.view.done:
            self._server.stop()

    def _due(self, now: Now) -> Iterator[Message]:
        stamp_ns, view = now.stamp_ns, now.view
        # what is said once comes again and again: nobody is told what was before
        if view.elapsed_s - self._described_s > 2.0:
            self._described_s, self._headline = view.elapsed_s, ""
            yield from self._messages.first(stamp_ns)
        if np.isfinite(now.q).all():
            yield self._joints("/joint_states", stamp_ns, now.tau, now.q, now.dq)
        if np.isfinite(now.residual).all():
            yield self._joints("/residuals", stamp_ns, now.residual)
            yield self._joints("/residual_noise", stamp_ns, now.noise)
        if view.push is not None:
            yield self._joints(EXTERNAL_TORQUES, view.push.stamp_ns, view.push.torque)
        if now.headline != self._headline:
            self._headline = now.headline
            yield Message("/state", STRING, stamp_ns, {"data": now.headline})
        yield from self._messages.seen(view, stamp_ns, now.q)

    def _joints(
        self, topic: str, stamp_ns: int, tau: Array, q: Array = NONE, dq: Array = NONE
    ) -> Message:
        """Torques (n,) N m, where they are told with q and dq (n,) rad and rad/s."""
        signals = {"position": q, "velocity": dq, "effort": tau}
        fields = {"header": header(stamp_ns), "name": self._names.joints, **signals}
        return Message(topic, JOINT_STATE, stamp_ns, fields)
