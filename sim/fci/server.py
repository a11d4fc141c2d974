"""The robot on a network: one client at a time, one state per millisecond; nothing blocks.

Clients get the arm as a model library in protocol 5, as URDF in protocol 10. The library's source
is C with one arm's numbers, built with the machine's own compiler. It has thirty functions by name
(libfranka 0.9.2): `Ji_J_Jk` and `O_J_Jk`, Jacobians in the frame's own and in base axes; `O_T_Jk`,
poses; k = 1..7 joints, 8 flange, 9 end effector; `M_NE`, `c_NE`, `g_NE`, mass matrix, Coriolis and
gravity torques with a load. Matrices are column-major.

libfranka 0.21 demands of the URDF seven movable joints with `joint1` to `joint7` in their names,
each with its limits and with `position_based_velocity_limits`, and a link that is called exactly
`link8`, the flange.
"""

from __future__ import annotations

import argparse
import os
import platform
import select
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from sim.fci.clock import Ticks, undisturbed
from sim.fci.codec import (
    COMMAND_BYTES,
    HOST,
    LIMIT_REPLY,
    PORT,
    TICK_S,
    VERSIONS,
    BadRequest,
    Request,
    RequestReader,
    RobotCommand,
    Status,
    read_command,
    reply,
)
from sim.fci.faults import AT_A_TIME, Spoiler, chosen
from sim.fci.gripper import PORT as GRIPPER_PORT
from sim.fci.gripper import GripperServer
from sim.fci.robot import Reporter, Robot
from sim.options import Ending, sum_up
from sim.scenarios import Scenario, build
from sim.truth import FLANGE_M, Truth, body_of, joint_text, limit_text, link_text


class ClientSession:
    """A client from its TCP connection to its end.

    Attributes:
        open: the connection stands.
        connected: the Connect request has succeeded; states are sent.
    """

    def __init__(self, tcp: socket.socket, version: int, unused: Counter[str]) -> None:
        """Args: unused: counts datagrams that are `foreign` (no command of this version) or `stale`
        (for a state other than the last one).
        """
        tcp.setblocking(False)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._tcp, self._version, self._unused = tcp, version, unused
        self._udp: socket.socket | None = None
        self._reader, self._out = RequestReader(version), bytearray()
        self.open = True

    @property
    def connected(self) -> bool:
        """States are sent."""
        return self.open and self._udp is not None

    def fileno(self) -> int:
        """Of the TCP connection, for select."""
        return self._tcp.fileno()

    def begin_states(self, port: int) -> None:
        """Send states to this UDP port of the client."""
        own, peer = self._tcp.getsockname()[0], self._tcp.getpeername()[0]
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.setblocking(False)
        self._udp.bind((own, 0))
        self._udp.connect((peer, port))

    def requests(self, answer: Callable[[Request], bytes | None]) -> None:
        """Answer what has come in over TCP; a client that leaves or talks nonsense is dropped."""
        try:
            data = self._tcp.recv(4096)
            if not data:
                self.close()
                return
            for request in self._reader.feed(data):
                said = answer(request)
                if said is not None:
                    self.reply(said)
        except BlockingIOError:
            pass
        except (OSError, BadRequest):
            self.close()
        if self._out:
            self._flush()

    def reply(self, data: bytes) -> None:
        """Send over TCP, now or when the client's buffer has room again."""
        self._out += data
        self._flush()
        if len(self._out) > 16 << 20:  # bytes that a client does not fetch
            self.close()

    def send(self, state: bytes | bytearray) -> None:
        """One datagram; one that the system does not take is lost, as on a network."""
        if self._udp is None:
            return
        with suppress(OSError):  # buffer full, or nobody listens at that port (any more)
            self._udp.send(state)

    def wait_for_command(self, message_id: int, patience_s: float) -> RobotCommand | None:
        """The command that answers the last state; None where a request comes first, or nothing.

        Raises TimeoutError where nothing came in so many seconds.
        """
        until = time.monotonic() + patience_s
        while (found := self.command(message_id)) is None and self._udp is not None:
            left_s = until - time.monotonic()
            if left_s <= 0.0:
                raise TimeoutError
            if self._tcp in select.select([self._tcp, self._udp], [], [], left_s)[0]:
                break
        return found

    def command(self, message_id: int) -> RobotCommand | None:
        """The command that answers the last state, if it is there."""
        found = None
        if self._udp is None:
            return None
        for _ in range(64):  # more would be a flood
            try:
                data = self._udp.recv(COMMAND_BYTES[10] + 1)
            except BlockingIOError:
                break
            except OSError:  # an earlier state found nobody at the client's port
                continue
            command = read_command(data, self._version)
            if command is None:
                self._unused["foreign"] += 1
            elif command.message_id == message_id:
                found = command
            else:
                self._unused["stale"] += 1
        return found

    def close(self) -> None:
        """End both connections; may be called more than once."""
        self.open = False
        self._tcp.close()
        if self._udp is not None:
            self._udp.close()

    def _flush(self) -> None:
        if not self.open:
            return
        try:
            sent = self._tcp.send(self._out)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        del self._out[:sent]


class FciServer:
    """A simulated Franka robot that speaks one version of the protocol.

    While no client is connected and the arm stands, the simulated world stands as well.

    Args:
        scenario: the arm, and the seed of noise and faults.
        port: TCP port on 127.0.0.1; 0 takes a free one.
        protocol: 5 (FER/Panda) or 10 (FR3).
        faults: texts, see `sim.faults`.
        core: processor to stay on; None leaves it to the system.
        patience_s: so long the world stands still for a command that a client owes, once until
            the next one comes. No robot does: for clients on a busy machine.

    Attributes:
        port: the TCP port.
        protocol: the version it speaks.
        robot: the robot.
        hand: a gripper to serve beside it, where there is one; this class's to close.

    Raises:
        ValueError: no such protocol or fault; names the choices.
        OSError: the port is taken.
    """

    def __init__(
        self,
        scenario: Scenario,
        port: int = PORT,
        protocol: int = 5,
        faults: Sequence[str] = (),
        core: int | None = None,
        patience_s: float = 0.0,
    ) -> None:
        if protocol not in VERSIONS:
            raise ValueError(f"no protocol {protocol}; have: 5, 10")
        self._spoiler = Spoiler(faults, scenario.seed)
        self.protocol = self._version = protocol
        self.hand: GripperServer | None = None
        self._core, self._patience_s, self._patient = core, patience_s, patience_s > 0.0
        said = (int(fault.value) for fault in self._spoiler.acting("version", 0.0))
        self._says = next(said, protocol)
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._listener.bind((HOST, port))
            self.robot = Robot(scenario, protocol)
        except BaseException:
            self._listener.close()
            raise
        truth = self.robot.arm.truth
        # What a client gets as a model: a library for x64 Linux, or URDF.
        self._model = _built(model_source(truth)) if protocol == 5 else robot_urdf(truth).encode()
        self._reporter = Reporter(self.robot)
        self._reporter.refresh()
        self._reporter.fill(0)  # what is compiled on first use is compiled before a client comes
        self._listener.setblocking(False)
        self._listener.listen()
        self.port: int = self._listener.getsockname()[1]
        self._session: ClientSession | None = None
        self._ticks = Ticks()
        self._tick = self._id = self._silent_until = 0
        self._owed = self._answering = False  # a command for the last state; any in this motion
        self._sent = self._clients = self._refused = 0
        self._unused: Counter[str] = Counter()

    def serve(self, stop: Callable[[], bool]) -> None:
        """Run the robot until `stop()` is true."""
        with undisturbed(self._core):
            self._ticks.restart()
            while not stop():
                if self._session is None and not self.robot.moving:
                    wait_s = 0.05 if self.hand is None else 0.01  # s, as often as it has a state
                    select.select([self._listener], [], [], wait_s)
                    self._ticks.restart()
                    if self.hand is not None:
                        self.hand.poll()
                    self._accept()
                    continue
                self._ticks.wait()
                self._one_tick()
                if self._session is not None:
                    self._session.requests(self._answer)
                    if not self._session.open:
                        self._drop()
                self._accept()
                if self.hand is not None and self._tick % 10 == 0:
                    self.hand.poll()

    def summary(self) -> dict[str, Any]:
        """What happened so far."""
        robot = self.robot
        return {
            "protocol": self._version,
            "ticks": self._tick,
            "states_sent": self._sent,
            "stalled_ms": self._ticks.stalled,
            "clients": self._clients,
            "refused_clients": self._refused,
            "commands_received": robot.received,
            "commands_missed": robot.missed,
            "commands_stale": self._unused["stale"],
            "foreign_datagrams": self._unused["foreign"],
            "violations": list(robot.violations),
            "faults": dict(self._spoiler.counts),
        }

    def close(self) -> None:
        """Close the connections and free the simulator."""
        self._drop()
        self._listener.close()
        if self.hand is not None:
            self.hand.close()
        self.robot.arm.plant.close()

    def _one_tick(self) -> None:
        """Command in, world on, state out."""
        self._tick += 1
        self._strike()
        session, robot, command = self._session, self.robot, None
        if session is not None:
            before = self._unused["stale"]
            if self._owed and self._patient:  # the world slips while one that is owed is late
                try:
                    command = session.wait_for_command(self._id, self._patience_s)
                except TimeoutError:
                    self._patient = False
            else:
                command = session.command(self._id)
            # It may be late from its very first command on, which then answers no tick.
            self._answering = robot.motion is not None and (
                self._answering or robot.motion.begun or self._unused["stale"] > before
            )
            if command is not None and self._spoiler.strikes("drop_commands", self._tick * TICK_S):
                command = None
        if command is not None or robot.motion is None:
            self._patient = self._patience_s > 0.0
        robot.tick(command)
        self._id += 1
        self._owed = False
        if session is None or not session.connected:
            return
        if self._tick >= self._silent_until:
            self._reporter.fill(self._id)
            self._spoiler.spoil_values(self._reporter.frame, self._tick * TICK_S)
            for data in self._spoiler.deliver(self._reporter.frame.data, self._tick):
                session.send(data)
                self._owed = robot.motion is not None and (self._answering or robot.motion.begun)
            self._sent += 1
        for data in robot.take_replies():
            session.reply(data)

    def _strike(self) -> None:
        """Faults that happen once."""
        for fault in self._spoiler.once(AT_A_TIME, self._tick * TICK_S):
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
        self._session = ClientSession(tcp, self._version, self._unused)

    def _drop(self) -> None:
        session, self._session, self._owed = self._session, None, False
        if session is None:
            return
        session.close()
        self.robot.drop_client()
        self._spoiler.network.forget()

    def _answer(self, request: Request) -> bytes | None:
        """The reply to a request, None where it comes later."""
        session, version = self._session, self._version
        assert session is not None
        if request.name == "Connect":
            wanted, port = request.connect_terms()
            agreed = wanted == self._says and port != 0
            if agreed and not session.connected:
                session.begin_states(port)
            status = Status.OK if agreed else Status.INCOMPATIBLE
            return reply(request, status, version, struct.pack("<H", self._says))
        if not session.connected:
            raise BadRequest(f"{request.name} before Connect")
        if request.name == "GetCartesianLimit":
            return reply(request, Status.OK, version, bytes(LIMIT_REPLY))
        if request.name in ("LoadModelLibrary", "GetRobotModel"):
            strange = request.name == "LoadModelLibrary" and request.payload != b"\0\0"
            if self._model is None or strange:
                return reply(request, Status.ERROR, version)
            return reply(request, Status.OK, version, self._model)
        said = self.robot.request(request)
        self._reporter.refresh()
        return said


def run(args: argparse.Namespace) -> int:
    """`adapter sim fci`: serve until a signal comes or the time is over. Raises ValueError."""
    scenario = build(args.scenario, args.seed, **chosen(args))
    hand = _hand(args)
    try:
        server = FciServer(scenario, args.port, args.protocol, args.fault, args.core, args.patience)
    except OSError as error:
        raise ValueError(_taken(args.port, error)) from error
    server.hand = hand
    try:
        with Ending(args.duration) as ending:
            address = f"fci://{HOST}" + (f":{server.port}" if server.port != PORT else "")
            protocol = f"(protocol {server.protocol})"
            print(f"ready: a simulated arm on {address} {protocol}", flush=True)
            if hand is not None:
                print(f"the gripper on {HOST}:{hand.port}", flush=True)
            server.serve(ending.is_set)
    finally:
        server.close()
    sum_up(server.summary(), None, args.json)
    return 0


def _hand(args: argparse.Namespace) -> GripperServer | None:
    """The gripper: on its port where the robot is on its own, or where one is named."""
    port = args.gripper_port
    if port is None:
        if args.port != PORT:
            return None
        port = GRIPPER_PORT
    try:
        return GripperServer(port, args.object)
    except OSError as error:
        raise ValueError(_taken(port, error)) from error


def _taken(port: int, error: OSError) -> str:
    why = os.strerror(error.errno or 0)
    return f"port {port} of {HOST} cannot be used ({why}); stop what uses it"


_HEAD = """#include <math.h>
#include <string.h>
#define N 7
"""
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
OPTIONS = ("-O2", "-shared", "-fPIC", "-x", "c", "-", "-lm")


def model_source(truth: Truth) -> str:
    """The whole source for one arm."""
    tables = (
        _table("R0[N][3][3]", truth.R.ravel()),
        _table("P0[N][3]", truth.p.ravel()),
        _table("THETA[N][10]", truth.theta.ravel()),
    )
    body = (resources.files(__package__) / "model.c").read_text("utf-8")
    return "".join((_HEAD, f"#define FLANGE {FLANGE_M!r}\n", *tables, body, *_frames()))


def _table(name: str, values: Iterable[float]) -> str:
    return f"static const double {name} = {{{', '.join(repr(float(x)) for x in values)}}};\n"


def _frames() -> list[str]:
    """The functions that differ only in the frame; the first joint's Jacobians take no posture."""
    out = ["static const double ZERO[N];\n"]
    for k in range(1, 10):
        tool, given = ("tool", "const double *tool, ") if k == 9 else ("0", "")
        q, posture = ("ZERO", "") if k == 1 else ("q", "const double *q, ")
        count = min(k, 8)
        for name, body in (("Ji_J_J", 1), ("O_J_J", 0)):
            call = f"jacobian({q}, {count}, {tool}, {body}, out)"
            out.append(f"void {name}{k}({posture}{given}double *out) {{ {call}; }}\n")
        call = f"pose(q, {count}, {tool}, out)"
        out.append(f"void O_T_J{k}(const double *q, {given}double *out) {{ {call}; }}\n")
    return out


@cache
def _built(source: str) -> bytes | None:
    """The library's bytes; None without a C compiler, or where it does not build for x64 Linux."""
    if COMPILER is None or (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return None
    with tempfile.TemporaryDirectory() as work:
        built = Path(work) / "model.so"
        try:
            subprocess.run(
                [COMPILER, *OPTIONS, "-o", str(built)],
                input=source.encode(),
                capture_output=True,
                timeout=60.0,
                check=True,
            )
        except (OSError, subprocess.SubprocessError):
            return None
        return built.read_bytes()


def robot_urdf(truth: Truth) -> str:
    """The arm without payloads and losses."""
    parts = ['<robot name="simulated_arm">', '<link name="link0"/>']
    slowing, offset = truth.limits.acceleration, np.zeros(truth.n)
    if truth.limits.slowing is not None:
        slowing, offset = truth.limits.slowing.deceleration, truth.limits.slowing.offset
    for j in range(truth.n):
        limits = (
            f"{limit_text(truth.limits, j)}<position_based_velocity_limits "
            f'velocity_offset="{float(offset[j])!r}" deceleration_limit="{float(slowing[j])!r}"/>'
        )
        links, place = (f"link{j}", f"link{j + 1}"), (truth.p[j], truth.R[j])
        parts.append(link_text(links[1], *body_of(truth.theta[j])))
        parts.append(joint_text(f"joint{j + 1}", links, place, limits))
    parts.append('<link name="link8"/>')
    parts.append(
        f'<joint name="joint8" type="fixed"><origin xyz="0 0 {FLANGE_M!r}" rpy="0 0 0"/>'
        '<parent link="link7"/><child link="link8"/></joint>'
    )
    return "\n".join([*parts, "</robot>"])
