"""The process that is on the network for the driver: it hears states, sends commands, and brakes.

Of its own for three reasons. The threads and the decoding of DDS cost the loop nothing. When the
loop's process is gone, or its commands stay away for `SILENCE_S`, this one brakes the arm and
holds it: a controller of ros2_control would go on with the last torque for ever. And a second
publisher of commands is noticed, whoever it is.

It ends when the driver lets go of its standard input, once the arm stands. What it has to say goes
to standard output, one JSON object a line: {"ready": ...}, {"fault": ...}, {"note": ...}.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from drivers.files.messages import decode
from drivers.files.ros import CdrError, Layout, parse_joint_state
from drivers.files.ros_types import FLOAT64_MULTI_ARRAY, JOINT_STATE, STRING
from drivers.interface import Array, DriverError
from drivers.ros2.holding import Braker
from drivers.ros2.memory import Asked, Doing, Memory, Refusal
from drivers.ros2.settings import parse
from drivers.ros2.wire import Found, Network, Publication, described

DESCRIPTION = "/robot_description"
# For the first states, s; where discovery shows somebody who sends them
FIRST_S, SLOW_S = 4.0, 15.0
SEEN_S, MEASURED = 1.0, 20  # at least, before others are judged; messages that tell the rate
SILENCE_S = 0.05  # without a command, of an arm that is driven
HELD_S = 10.0  # that an arm is held for which nobody asks any more
FASTEST, JUMP_RAD = 30.0, 0.05  # rad/s, rad: no joint is further on than that
JUMPS = 20  # in a row are no disturbance: the arm is somewhere else
LEAST_HZ = 800  # below, what brakes the arm (`holding`) does not hold it against its weight
BRAKES = (Doing.BRAKING, Doing.HOLDING)


class Start(NamedTuple):
    """What the bridge is told at its start, as JSON on its command line.

    Attributes:
        address: of the arm; joints: names in the driver's order.
        allow_motion: whether commands may be sent.
        rescue: brake at once: another bridge died while the arm was driven.
        memory, wake, nudge: descriptors: the shared block, what wakes the driver when a state is
            there, and what wakes the bridge when a command is.
    """

    address: str
    joints: Sequence[str]
    allow_motion: bool
    rescue: bool
    memory: int
    wake: int
    nudge: int


def runs_of(data: bytes, layout: Layout | None = None) -> tuple[str, list[Array]]:
    """Byte order of a joint state, and its positions, velocities and efforts.

    Raises CdrError where it is none.
    """
    layout = layout or parse_joint_state(data)
    order = "<" if layout.little else ">"
    places = (run for run in layout.doubles if isinstance(run, slice))
    return order, [np.frombuffer(data[run], f"{order}f8") for run in places]


class States:
    """Joint states as (3, n) arrays in the driver's order; what cannot be is refused.

    Args:
        joints: in the driver's order.
        refused: takes what is refused.
    """

    def __init__(self, joints: Sequence[str], memory: Memory) -> None:
        self._joints, self._memory = list(joints), memory
        self._layout: Layout | None = None
        self._order: list[int] = []
        self._last: tuple[int, Array] | None = None
        self.jumps = 0

    def take(self, data: bytes) -> tuple[int, Array] | None:
        """Stamp and (3, n) of a message; None where it is refused."""
        found = self._judged(data)
        if isinstance(found, Refusal):
            self._memory.words.refused[found] += 1
            return None
        self.jumps, self._last = 0, (found[0], found[1][0])
        return found

    def _judged(self, data: bytes) -> tuple[int, Array] | Refusal:
        try:
            layout = parse_joint_state(data)
        except CdrError:
            return Refusal.UNREADABLE
        if self._layout is None or layout.names != self._layout.names:
            if not set(self._joints) <= set(layout.names):
                return Refusal.OTHER_JOINTS
            self._order = [layout.names.index(name) for name in self._joints]
        self._layout = layout
        order, runs = runs_of(data, layout)
        if any(len(run) != len(layout.names) for run in runs):
            return Refusal.INCOMPLETE
        values = np.stack([run[self._order] for run in runs]).astype(np.float64)
        sec, nanosec = np.frombuffer(data, f"{order}i4", 2, 4).tolist()
        stamp_ns = sec * 1_000_000_000 + nanosec
        if not np.isfinite(values).all():
            return Refusal.NOT_FINITE
        if self._last is not None:
            before_ns, before = self._last
            if stamp_ns <= before_ns:
                return Refusal.OLD
            reach = JUMP_RAD + FASTEST * 1e-9 * (stamp_ns - before_ns)
            if np.abs(values[0] - before).max() > reach and self.jumps < JUMPS:
                self.jumps += 1
                return Refusal.JUMP
        return stamp_ns, values


class Bridge:
    """See the module. Raises DriverError where there is no such arm."""

    def __init__(self, start: Start) -> None:
        self._start, self._where = start, parse(start.address)
        where = self._where
        self._memory = Memory(len(start.joints), start.memory)
        self._network = Network(where.domain, where.local)
        self._states = self._network.subscribe(where.states, JOINT_STATE)
        self._texts = self._network.subscribe(DESCRIPTION, STRING, latched=True)
        self._reader = States(start.joints, self._memory)
        self._commands: Publication | None = None
        if start.allow_motion and where.command:
            self._commands = self._network.publish(where.command, FLOAT64_MULTI_ARRAY)
        order = where.joints or start.joints
        self._order = [start.joints.index(name) for name in order]
        self._lock, self._gone = threading.Lock(), threading.Event()
        self._sent = self._memory.words.sequence
        self._taken = False  # from the driver, which has to stop before it drives again
        self._heard = time.monotonic()
        self._look_at = self._idle_at = 0.0
        self._answer: Array | None = None

    def prepare(self) -> None:
        """Wait for the arm and look at it; says that it is ready. Raises DriverError."""
        first = self._first_states()
        names = parse_joint_state(first[-1]).names
        missing = [name for name in self._start.joints if name not in names]
        where = self._where
        if missing:
            raise DriverError(
                f"{where.states} has no joint {', '.join(missing)}; it has: {', '.join(names)}"
            )
        runs = dict(zip(("velocity", "effort"), runs_of(first[-1])[1][1:], strict=True))
        absent = [key for key, run in runs.items() if len(run) != len(names)]
        if absent:
            raise DriverError(
                f"{where.states} tells no {' and no '.join(absent)}; the arm's state interfaces "
                "have to be position, velocity and effort"
            )
        stamps = [np.frombuffer(data, "<i4", 2, 4).tolist() for data in first]
        steps = np.diff([sec + 1e-9 * nanosec for sec, nanosec in stamps])
        hz = 1.0 / max(float(np.median(steps)), 1e-9)
        if abs(hz / where.hz - 1.0) > 0.1:  # of the rate that was told
            raise DriverError(
                f"{where.states} comes at {hz:.0f} Hz, not {where.hz:.0f}; say hz={hz:.0f} in the "
                "address"
            )
        self._braker = Braker(self._effort(), 1.0 / where.hz, where.gravity)
        if self._commands is not None and not self._start.rescue:
            self._check_command(self._commands)
        self._memory.words.doing = Doing.BRAKING if self._start.rescue else Doing.LISTENING
        say(ready=list(names), effort=self._braker.effort.tolist())

    def _first_states(self) -> list[bytes]:
        """Enough to tell the rate, once others had time to be discovered. Raises DriverError."""
        found: list[bytes] = []
        topic, begin = self._where.states, time.monotonic()
        while len(found) < MEASURED or time.monotonic() < begin + SEEN_S:
            found += self._states.take()
            waited_s = time.monotonic() - begin
            if waited_s > FIRST_S and len(found) < MEASURED:
                seen = [x for x in self._network.publishers() if x.schema == JOINT_STATE]
                if waited_s > SLOW_S or all(x.topic != topic for x in seen):
                    raise DriverError(
                        f"{len(found)} joint states on {topic} within {waited_s:.0f} s in domain "
                        f"{self._where.domain}; topics of joint states that are "
                        f"published: {described(seen)}"
                    )
            time.sleep(0.002)
        return found

    def _effort(self) -> Array:
        """(n,) largest torques, from the address or the robot's description."""
        joints, told = self._start.joints, self._where.effort
        if told:
            if len(told) != len(joints):
                raise DriverError(f"effort has {len(told)} numbers for {len(joints)} joints")
            back = np.empty(len(joints))
            back[self._order] = told
            return back
        limits: dict[str, float] = {}
        for data in self._texts.take():
            limits = efforts_in(decode(STRING, data)["data"])
        missing = [name for name in joints if not limits.get(name, 0.0) > 0.0]
        if missing and self._commands is not None:
            raise DriverError(
                f"no largest torque is known of {', '.join(missing)}: nobody tells it on "
                f"{DESCRIPTION}; say effort=87,87,... in the address, one number for each joint"
            )
        return np.array([limits.get(name, np.inf) for name in joints])

    def _check_command(self, commands: Publication) -> None:
        topic, where = self._where.command, self._where
        if where.hz < LEAST_HZ and not where.gravity:
            raise DriverError(
                f"at {where.hz:.0f} Hz an arm cannot be held by torques that carry its weight: "
                f"controller_manager's update_rate has to be {LEAST_HZ} or more, or the arm has to "
                "carry its own weight (gravity=1)"
            )
        others = self._others(commands)
        if others:
            raise DriverError(
                f"somebody else publishes on {topic}; two that command an arm are one too many: "
                "stop the other one (ros2 topic info -v tells who it is)"
            )
        if not commands.listeners:
            heard = self._network.listeners()
            told = described([x for x in heard if x.schema == FLOAT64_MULTI_ARRAY])
            raise DriverError(
                f"no controller listens on {topic}; topics of commands that are listened to: "
                f"{told} (ros2 control list_controllers)"
            )

    def _others(self, commands: Publication) -> list[Found]:
        topic = self._where.command
        return [x for x in self._network.publishers() if x.topic == topic and x.key != commands.key]

    def run(self) -> None:
        """Until the driver is gone and the arm stands."""

        def wait_for_end() -> None:
            while sys.stdin.buffer.read(4096):
                pass
            self._gone.set()

        threading.Thread(target=wait_for_end, daemon=True).start()
        threading.Thread(target=self._pass_on, daemon=True).start()
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet

        waiter = WaitSet(self._network.participant)
        mask = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self._condition = ReadCondition(self._states.reader, mask)
        waiter.attach(self._condition)
        while not self._done():
            waiter.wait(2_000_000)
            self._answer = None
            for data in self._states.take():
                self._take_state(data)
            with self._lock:
                if self._answer is not None and self._memory.words.doing in BRAKES:
                    self._send(self._answer)
                self._supervise()

    def _done(self) -> bool:
        if not self._gone.is_set():
            return False
        memory, now = self._memory, time.monotonic()
        if memory.words.doing == Doing.HOLDING and not self._idle_at:
            self._idle_at = now
        released = memory.words.asked == Asked.LISTEN or memory.words.doing == Doing.LISTENING
        held = self._idle_at > 0.0 and now > self._idle_at + HELD_S
        return released or held or now > self._heard + HELD_S

    def _pass_on(self) -> None:
        """Send a command as soon as it is there."""
        words = self._memory.words
        while True:
            os.eventfd_read(self._start.nudge)
            with self._lock:
                sequence = words.sequence
                if sequence == self._sent or words.asked != Asked.DRIVE or self._taken:
                    continue
                if words.doing != Doing.DRIVING:
                    self._braker.release()
                words.doing = Doing.DRIVING
                self._sent = sequence
                self._send(self._memory.command())

    def _send(self, tau: Array) -> None:
        if self._commands is not None:
            self._commands.write(encode_command(tau[self._order]))

    def _take_state(self, data: bytes) -> None:
        found = self._reader.take(data)
        if found is None:
            if self._reader.jumps == JUMPS:
                why = f"{JUMPS} joint states in a row are further on than joints move"
                with self._lock:
                    self._take_over(why)
            return
        stamp_ns, values = found
        self._heard = time.monotonic()
        self._memory.put_state(stamp_ns, time.monotonic_ns(), values)
        os.eventfd_write(self._start.wake, 1)
        with self._lock:
            doing = self._memory.words.doing
            if doing not in BRAKES:
                self._braker.listen(values[1], values[2])
                return
            self._answer = self._braker.torques(*values)  # of several at once the last one is sent
            if self._braker.standing:
                self._memory.words.doing = Doing.HOLDING

    def _supervise(self) -> None:
        """Brake where it is asked for, where commands stay away, or somebody else commands."""
        memory, now = self._memory, time.monotonic()
        if self._gone.is_set() and memory.words.asked == Asked.DRIVE:
            memory.words.asked = Asked.BRAKE  # nobody else is there to ask
        doing, asked = memory.words.doing, memory.words.asked
        if asked == Asked.BRAKE:
            self._taken = False
            if doing == Doing.DRIVING:
                memory.words.doing = Doing.BRAKING
        elif doing == Doing.DRIVING:
            unheard_s, silent_s = now - self._heard, now - 1e-9 * memory.words.beat_ns
            if silent_s > SILENCE_S and unheard_s > 0.5 * silent_s:  # a command answers a state
                topic = self._where.states
                self._take_over(f"{topic} has been silent for {1e3 * unheard_s:.0f} ms")
            elif silent_s > SILENCE_S:
                self._take_over(f"no command came for {1e3 * silent_s:.0f} ms")
        if memory.words.doing in BRAKES and now - self._heard > 0.005:  # s, blind
            self._send(self._braker.blind())
        if self._commands is not None and now > self._look_at:
            self._look_at = now + 0.25  # between two looks at who else commands
            if doing == Doing.DRIVING and self._others(self._commands):
                topic = self._where.command
                self._take_over(f"somebody else began to publish on {topic}")

    def _take_over(self, why: str) -> None:
        if self._memory.words.doing == Doing.DRIVING:
            self._taken = True
            self._memory.words.doing = Doing.BRAKING
            why = f"{why}; the arm is braked and held"
        say(fault=why)


def efforts_in(urdf: str) -> dict[str, float]:
    """Largest torques by joint that a URDF tells; none where it is no URDF."""
    try:
        root = ET.fromstring(urdf)
    except ET.ParseError:
        return {}
    found = {}
    for joint in root.iter("joint"):
        limit = joint.find("limit")
        if limit is not None and "effort" in limit.attrib:
            found[joint.get("name", "")] = float(limit.attrib["effort"])
    return found


def encode_command(tau: Array) -> bytes:
    """CDR of a std_msgs/Float64MultiArray without a layout."""
    head = np.array([0x00000100, 0, 0, len(tau)], "<u4")  # dimensions, offset, then the numbers
    return head.tobytes() + bytes(4) + np.asarray(tau, "<f8").tobytes()


def say(**what: Any) -> None:
    """One line to the driver."""
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def main() -> None:
    """Run by the driver."""
    start = Start(*json.loads(sys.argv[1]))
    with contextlib.suppress(OSError):  # the threads of DDS begin later and inherit it
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(75))  # above the loop
    try:
        bridge = Bridge(start)
        bridge.prepare()
    except DriverError as error:
        say(fault=str(error))
        return
    gc.collect()
    gc.freeze()
    bridge.run()


if __name__ == "__main__":
    main()
