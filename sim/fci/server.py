"""The robot on a network: one client at a time, one state per millisecond."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sim.fci.clock import Ticks, undisturbed
from sim.fci.faults import Fault
from sim.fci.layout import VERSIONS
from sim.fci.model_library import model_library
from sim.fci.report import Reporter
from sim.fci.requests import BadRequest, Request, connect_reply, limit_reply, reply
from sim.fci.robot import Robot
from sim.fci.robot_urdf import robot_urdf
from sim.fci.session import Session
from sim.fci.spoil import Spoiler
from sim.fci.statuses import ERROR, INCOMPATIBLE, OK
from sim.scenarios import build

HOST = "127.0.0.1"
PORT = 1337  # clients know no other
IDLE_S = 0.05  # how often a server without a client looks whether it is to stop


class FciServer:
    """A simulated Franka robot that speaks one version of the protocol.

    While no client is connected and the arm stands, the simulated world stands as well.

    Args:
        port: TCP port on 127.0.0.1; 0 takes a free one.
        protocol: 5 (FER/Panda) or 10 (FR3).
        scenario: of `sim.scenarios`.
        seed: of truth, noise and faults.
        faults: texts as in `sim.fci.faults`.
        options: of the scenario.
        core: processor to stay on; None leaves it to the system.

    Attributes:
        port: the TCP port.
        protocol: the version it speaks.
        robot: the robot.

    Raises:
        ValueError: no such protocol, scenario, option or fault; names the choices.
        OSError: the port is taken.
    """

    def __init__(
        self,
        port: int = PORT,
        protocol: int = 5,
        scenario: str = "nominal",
        seed: int = 0,
        faults: Sequence[str] = (),
        options: Mapping[str, Any] | None = None,
        core: int | None = None,
    ) -> None:
        if protocol not in VERSIONS:
            raise ValueError(f"no protocol {protocol}; have: 5, 10")
        asked = [Fault.of(text) for text in faults]
        self.protocol = self._version = protocol
        self._core = core
        self._says = next((int(f.value) for f in asked if f.name == "version"), protocol)
        self._spoiler = Spoiler(asked, seed)
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((HOST, port))
            self.robot = Robot(build(scenario, seed, **(options or {})), protocol)
        except BaseException:
            self._listener.close()
            raise
        self._model = self._model_reply()
        self._reporter = Reporter(self.robot)
        self._reporter.refresh()
        self._reporter.fill(
            0
        )  # whatever is compiled on first use is compiled before a client comes
        self._listener.setblocking(False)
        self._listener.listen()
        self.port: int = self._listener.getsockname()[1]
        self._session: Session | None = None
        self._ticks = Ticks()
        self._tick = self._id = self._silent_until = 0
        self._sent = self._clients = self._refused = 0
        self._foreign = self._stale = 0

    def serve(self, stop: Callable[[], bool]) -> None:
        """Run the robot until `stop()` is true."""
        with undisturbed(self._core):
            self._ticks.restart()
            while not stop():
                if self._session is None and not self.robot.moving:
                    select.select([self._listener], [], [], IDLE_S)
                    self._ticks.restart()
                    self._accept()
                    continue
                self._ticks.wait()
                self._one_tick()
                self._talk()

    def summary(self) -> dict[str, Any]:
        """What happened so far."""
        robot, session = self.robot, self._session
        return {
            "protocol": self._version,
            "ticks": self._tick,
            "states_sent": self._sent,
            "stalled_ms": self._ticks.stalled,
            "clients": self._clients,
            "refused_clients": self._refused,
            "commands_received": robot.received,
            "commands_missed": robot.missed,
            "commands_stale": self._stale + (session.stale if session else 0),
            "foreign_datagrams": self._foreign + (session.foreign if session else 0),
            "violations": list(robot.violations),
            "faults": dict(self._spoiler.counts),
        }

    def close(self) -> None:
        """Close the connections and free the simulator."""
        self._drop()
        self._listener.close()
        self.robot.arm.close()

    def _one_tick(self) -> None:
        """Command in, world on, state out."""
        self._tick += 1
        self._strike()
        session, robot, command = self._session, self.robot, None
        if session is not None:
            command = session.command(self._id)
            if command is not None and self._spoiler.loses_command(self._tick):
                command = None
        robot.tick(command)
        self._id += 1
        if session is None or not session.connected:
            return
        if self._tick >= self._silent_until:
            self._reporter.fill(self._id)
            self._spoiler.spoil_values(self._reporter.frame, self._tick)
            for data in self._spoiler.deliver(self._reporter.frame.data, self._tick):
                session.send(data)
            self._sent += 1
        for data in robot.take_replies():
            session.reply(data)

    def _strike(self) -> None:
        """Faults that happen once."""
        for fault in self._spoiler.due(self._tick):
            if fault.name == "reflex":
                self.robot.trip(fault.word)
            elif fault.name == "user_stop":
                self.robot.stop_by_user(round(fault.value * 1000))
            elif fault.name == "silence":
                self._silent_until = self._tick + round(fault.value * 1000)
            elif fault.name == "clock":
                self._id = max(0, self._id + int(fault.value))
            else:
                self._drop()

    def _talk(self) -> None:
        """Whatever came in over TCP."""
        if self._session is not None:
            self._session.requests(self._answer)
            if not self._session.open:
                self._drop()
        self._accept()

    def _accept(self) -> None:
        """Let a client in; one that comes while another is there finds its connection closed."""
        try:
            tcp, _ = self._listener.accept()
        except OSError:
            return
        if self._session is not None:
            self._refused += 1
            tcp.close()
            return
        self._clients += 1
        self._session = Session(tcp, self._version)

    def _drop(self) -> None:
        session, self._session = self._session, None
        if session is None:
            return
        session.close()
        self._foreign += session.foreign
        self._stale += session.stale
        self.robot.drop_client()
        self._spoiler.forget()

    def _answer(self, request: Request) -> bytes | None:
        """The reply to a request, None where it comes later."""
        session, version = self._session, self._version
        assert session is not None
        if request.name == "Connect":
            wanted, port = request.connect_terms()
            if wanted != self._says or port == 0:
                return connect_reply(request, INCOMPATIBLE, version, self._says)
            if not session.connected:
                session.begin_states(port)
            return connect_reply(request, OK, version, self._says)
        if not session.connected:
            raise BadRequest(f"{request.name} before Connect")
        if request.name == "GetCartesianLimit":
            return limit_reply(request, version)
        if request.name in ("LoadModelLibrary", "GetRobotModel"):
            return self._send_model(request)
        said = self.robot.request(request)
        self._reporter.refresh()
        return said

    def _send_model(self, request: Request) -> bytes:
        if self._model is None or (
            request.name == "LoadModelLibrary" and request.payload != b"\0\0"
        ):
            return reply(request, ERROR, self._version)
        return reply(request, OK, self._version, self._model)

    def _model_reply(self) -> bytes | None:
        """What a client gets as a model: a library for x64 Linux, or URDF."""
        truth = self.robot.arm.truth
        return model_library(truth) if self._version == 5 else robot_urdf(truth).encode()
