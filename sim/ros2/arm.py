"""The arm on the network: joint_state_broadcaster, JointGroupEffortController and their machine.

Everything stays on this machine: the loopback interface, without multicast. Joint states come in
alphabetical order and with the fingers of a hand among them, as the broadcaster tells all joints
that it knows; a command's numbers are in the controller's own order, joint 1 first. The controller
goes on with the last command for ever; a watch of the drives brakes when none is new (`watch_s`),
unless it is 0.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from drivers.interface import DriverError
from sim.faults import Faults
from sim.fci.clock import PRIORITY, Ticks, undisturbed
from sim.options import Ending, options_of, sum_up
from sim.ros2.options import KINDS
from sim.scenarios import Scenario, build
from sim.truth import Truth, joint_text, limit_text

LOOPBACK = """<CycloneDDS><Domain Id="any"><General><Interfaces>
<NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>64</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>
</Discovery></Domain></CycloneDDS>"""
FINGERS = {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02}
OFF_RAD = 0.5  # by which a joint is wrong where faults say so
SECOND_NS = 1_000_000_000


def _message(package: str, kind: str, /, **fields: Any) -> Any:
    return make_idl_struct(f"{kind}_", f"{package}.msg.dds_.{kind}_", fields)


# The four messages that the arm speaks; names and layout are ROS 2's.
Doubles = types.sequence[types.float64]
Time = _message("builtin_interfaces", "Time", sec=types.int32, nanosec=types.uint32)
Header = _message("std_msgs", "Header", stamp=Time, frame_id=str)
JointState = _message(
    "sensor_msgs",
    "JointState",
    header=Header,
    name=types.sequence[str],
    position=Doubles,
    velocity=Doubles,
    effort=Doubles,
)
Dimension = _message(
    "std_msgs", "MultiArrayDimension", label=str, size=types.uint32, stride=types.uint32
)
Layout = _message(
    "std_msgs", "MultiArrayLayout", dim=types.sequence[Dimension], data_offset=types.uint32
)
Float64MultiArray = _message("std_msgs", "Float64MultiArray", layout=Layout, data=Doubles)
String = _message("std_msgs", "String", data=str)


@dataclass(frozen=True)
class Place:
    """Where the arm is on the network.

    Attributes:
        domain: of DDS; states, commands: topics of ROS.
        every: ticks between two joint states.
        watch_s: the drives brake when no command is new for so long; 0 never.
        described: /robot_description is published.
    """

    domain: int
    states: str
    commands: str
    every: int = 1
    watch_s: float = 0.1
    described: bool = True


class ServedArm:
    """See the module.

    Args:
        scenario: the arm.
        place: on the network.
        faults: that strike.
    """

    def __init__(self, scenario: Scenario, place: Place, faults: Sequence[str] = ()) -> None:
        self._place, self._faults = place, Faults(faults, KINDS, (scenario.seed, 5))
        self._plant = scenario.plant(substeps=2)
        with suppress(OSError):  # the threads of DDS inherit it: a machine that is busy delays them
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        self._domain = Domain(place.domain, LOOPBACK)
        self._participant = DomainParticipant(place.domain)
        self._states = self._writer(place.states, JointState, latched=False)
        topic = Topic(self._participant, "rt" + place.commands, Float64MultiArray)
        self._commands = DataReader(self._participant, topic, qos=quality(False, 1))
        if place.described:
            self._description = self._writer("/robot_description", String, latched=True)
            self._description.write(String(description(scenario.truth)))
        names = (*self._plant.joint_names, *FINGERS)
        self._order = np.argsort(names)
        self._names = [names[k] for k in self._order]
        self._ticks, self._tick = Ticks(), 0
        self._driven = 0  # since this tick there are commands
        self._command: np.ndarray | None = None
        self._new_at = 0.0
        self._start_ns = time.time_ns()
        self._sent: Counter[str] = Counter()
        self._plant.read()

    def _writer(self, topic: str, kind: Any, latched: bool) -> DataWriter:
        named = Topic(self._participant, "rt" + topic, kind)
        return DataWriter(self._participant, named, qos=quality(latched, 1 if latched else 10))

    def serve(self, stop: Callable[[], bool]) -> None:
        """Until `stop()` is true."""
        with undisturbed():
            self._ticks.restart()
            while not stop():
                self._ticks.wait()
                self._one_tick()

    def _one_tick(self) -> None:
        """Commands in, world on, states out."""
        self._tick += 1
        now = time.monotonic()
        for message in self._commands.take(4):
            if not hasattr(message, "data"):
                continue  # who commanded has gone
            self._sent["commands"] += 1
            if len(message.data) != self._plant.truth.n or not np.isfinite(message.data).all():
                self._sent["bad commands"] += 1
                continue
            self._command, self._new_at = np.array(message.data), now
            self._driven = self._driven or self._tick
        watch_s = self._place.watch_s
        if self._command is not None and watch_s and now - self._new_at > watch_s:
            self._command = None
            self._sent["watch"] += 1
            self._plant.stop()
        if self._command is not None:
            try:
                self._plant.command(self._command)
            except DriverError:  # its own guard: a joint is out of range or too fast
                self._plant.stop()
        sample = self._plant.read()
        if self._tick % self._place.every == 0 and not self._strikes("silence"):
            self._publish(sample.q, sample.dq, sample.tau)

    def _publish(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> None:
        told = q.copy()
        if self._strikes("moved"):
            told += OFF_RAD
        if self._strikes("nan"):
            told[self._faults.pick(len(q))] = np.nan
        if self._strikes("jump"):
            told[self._faults.pick(len(q))] += OFF_RAD
        none = np.zeros(len(FINGERS))
        parts = np.r_[told, [*FINGERS.values()]], np.r_[dq, none], np.r_[tau, none]
        sec, nanosec = divmod(self._start_ns + self._tick * SECOND_NS // 1000, SECOND_NS)
        numbers = (part[self._order].tolist() for part in parts)
        self._states.write(JointState(Header(Time(sec, nanosec), ""), self._names, *numbers))
        self._sent["states"] += 1

    def _strikes(self, name: str) -> bool:
        since_s = (self._tick - self._driven) / 1000 if self._driven else 0.0
        return self._faults.strikes(name, since_s)

    def summary(self) -> dict[str, Any]:
        """What happened so far."""
        q, dq, _ = self._plant.link_state()
        return {
            "ticks": self._tick,
            "stalled_ms": self._ticks.stalled,
            **self._sent,
            **{f"fault {name}": count for name, count in self._faults.counts.items()},
            "braked": self._plant.braked,
            "fault": self._plant.fault,
            "q": q.tolist(),
            "dq": dq.tolist(),
        }

    def close(self) -> None:
        """Free the simulator."""
        self._plant.close()


def quality(latched: bool, depth: int) -> Qos:
    """As joint_state_broadcaster and the controllers have it: reliable and volatile."""
    durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)),
        durability,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def description(truth: Truth) -> str:
    """URDF of the joints with their limits; of the links their names."""
    parts, parent = ['<robot name="arm"><link name="base"/>'], "base"
    for j, (name, link) in enumerate(zip(truth.joint_names, truth.link_names, strict=True)):
        place = truth.p[j], truth.R[j]
        parts.append(f'<link name="{link}"/>')
        parts.append(joint_text(name, (parent, link), place, limit_text(truth.limits, j)))
        parent = link
    return "\n".join([*parts, "</robot>"])


def run(args: argparse.Namespace) -> int:
    """`adapter sim ros2`: serve until a signal comes or the time is over. Raises ValueError."""
    scenario = build(args.scenario, args.seed, **options_of(args.set))
    place = Place(
        args.domain, args.states, args.commands, args.every, args.watch, not args.no_description
    )
    arm = ServedArm(scenario, place, args.fault)
    try:
        with Ending(args.duration) as ending:
            hz = "" if args.every == 1 else f"&hz={1000 // args.every}"
            address = f"ros2://{args.states}?command={args.commands}&domain={args.domain}&local=1"
            print(f"ready: a simulated arm on {address}{hz}", flush=True)
            arm.serve(ending.is_set)
    finally:
        arm.close()
    sum_up(arm.summary(), None, args.json)
    return 0
