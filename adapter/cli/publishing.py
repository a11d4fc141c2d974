"""What is learned, as topics of ROS 2: of a run whose arm is on DDS itself.

A process of its own sends them (the view's), never the loop. Times are those of the arm's joint
states. Public types tell it to everybody; `panda_adapter_msgs/Estimate` tells all of it to whoever
has its definition (docs/ros2.md).

    /panda_adapter/estimates         panda_adapter_msgs/Estimate
    /panda_adapter/lambda, /theta    std_msgs/Float64MultiArray, rows and columns labelled
    /panda_adapter/load              std_msgs/Float64MultiArray: mass and its standard deviation, kg
    /panda_adapter/external_wrench   geometry_msgs/WrenchStamped on the last link, in its axes
    /panda_adapter/findings          diagnostic_msgs/DiagnosticArray
    /panda_adapter/timing            panda_adapter_msgs/Timing
    /tf, /tf_static                  the frames documented/... and learned/...
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from adapter.model.self_model import SelfModel
from adapter.realtime.run_messages import TF_FIXED, TF_MOVING, RunMessages, ShownArm, table_fields
from adapter.realtime.showing import DisplayJob, View
from adapter.signals.records import StateLayout, stamp_of
from drivers.files.estimates import EstimateNames
from drivers.files.mcap.writer import ESTIMATES
from drivers.files.messages import Message, encode
from drivers.files.ros_types import FLOAT64_MULTI_ARRAY, LAMBDA_FIELDS, LOAD, THETA_FIELDS
from drivers.registry import split_address
from drivers.ros2.settings import Ros2Settings, parse
from drivers.ros2.wire import Network, Publication

PREFIX = "/panda_adapter"


def publisher_job(address: str, robot: SelfModel, effects: tuple[str, ...]) -> DisplayJob | None:
    """What publishes beside a run; None where the arm is not on DDS."""
    if split_address(address)[0] != "ros2":
        return None
    make = partial(Publisher, parse(address), ShownArm.of(robot), effects)
    return DisplayJob(make, period_s=0.05, idle=True)


def together(jobs: Sequence[DisplayJob | None]) -> DisplayJob | None:
    """Several displays in one process, at the pace of the fastest; None where there is none."""
    asked = [job for job in jobs if job is not None]
    if len(asked) < 2:
        return asked[0] if asked else None
    period_s = min(job.period_s for job in asked)
    return DisplayJob(partial(_all_of, [job.make for job in asked]), period_s, idle=True)


def _all_of(makers: Sequence[Callable[[], Callable[[View], None]]]) -> Callable[[View], None]:
    shows = [make() for make in makers]

    def show(view: View) -> None:
        for each in shows:
            each(view)

    return show


class Publisher:
    """Sends what is new in a view.

    Args:
        settings: of the arm's address.
        arm: as documented; effects: learned beside θ.

    Raises:
        DriverError: no DDS.
    """

    def __init__(self, settings: Ros2Settings, arm: ShownArm, effects: tuple[str, ...]) -> None:
        tree = arm.documented.tree
        names = self._names = EstimateNames(tree.joint_names, tree.body_names, effects)
        self._messages, self._layout = RunMessages(names, arm), StateLayout(tree.n)
        self._network = Network(settings.domain, settings.local)
        self._publications: dict[str, Publication] = {}
        self._first = True

    def __call__(self, view: View) -> None:
        """Once for each look at the run."""
        if not len(view.records):
            return
        newest = view.records[-1]
        stamp_ns, q = stamp_of(newest), newest[self._layout.q].copy()
        found = self._messages.first(stamp_ns) if self._first else []
        self._first = False
        found += self._messages.seen(view, stamp_ns, q)
        if view.snapshot is not None and any(x.topic == ESTIMATES for x in found):
            for name, rows, columns, table in (
                ("/lambda", self._names.joints, LAMBDA_FIELDS, view.snapshot.lam),
                ("/theta", self._names.bodies, THETA_FIELDS, view.snapshot.theta),
            ):
                fields = table_fields((",".join(rows), ",".join(columns)), table)
                found.append(Message(name, FLOAT64_MULTI_ARRAY, stamp_ns, fields))
        for message in found:
            self._send(message)

    def _send(self, message: Message) -> None:
        if message.schema == LOAD:  # a public type, so that everybody reads it
            load = np.array([[message.fields["mass"], message.fields["mass_std"]]])
            fields = table_fields(("load", "mass,standard deviation"), load)
            message = message._replace(schema=FLOAT64_MULTI_ARRAY, fields=fields)
        topic = message.topic if message.topic in (TF_MOVING, TF_FIXED) else PREFIX + message.topic
        if topic not in self._publications:
            publish = self._network.publish(topic, message.schema, message.latched)
            self._publications[topic] = publish
        self._publications[topic].write(encode(message.schema, message.fields))
