"""What an arm looks like to the rest of the project: a sample, a protocol, an error."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError as DriverError  # light; by this name for everybody
from drivers.errors import EndOfStream as EndOfStream
from drivers.errors import NotReady as NotReady

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LinkMotion:
    """Motion of every moving link at one instant, each in its own link frame.

    Of Imus glued on links anyhow, only w and a, in the sensors' axes; all else is not a number.

    Attributes:
        twist: (n, 6) velocity of the link-frame origin and angular velocity [v; w], m/s, rad/s.
        accel: (n, 6) [a; dw]: linear acceleration of the origin as an accelerometer there reads
            it (at rest +9.81 m/s² upwards) and angular acceleration, m/s², rad/s².
    """

    twist: Array
    accel: Array


@dataclass(frozen=True, slots=True)
class JointSample:
    """What the arm says of one instant; NaN where nothing was measured.

    A driver that bridges a joint's missing message predicts its q and dq and leaves its tau NaN:
    such a sample serves a controller, and nobody learns from it.

    Attributes:
        stamp_ns: the instant, nanoseconds on the source's own clock.
        q: (n,) joint positions, rad.
        dq: (n,) joint velocities, rad/s.
        tau: (n,) link-side joint torques, gravity included, N m.
        links: measured motion of the links at the same instant, where the arm measures it.
        base: (9,) of a base that floats [v, w, a], in its own frame: velocity of its origin
            (zero where not measured), angular velocity, and what an accelerometer at its origin
            reads, m/s, rad/s, m/s².
    """

    stamp_ns: int
    q: Array
    dq: Array
    tau: Array
    links: LinkMotion | None = None
    base: Array | None = None


@dataclass
class CommandCount:
    """What became of the commands to an arm that sets the rhythm itself.

    Attributes:
        sent: commands that went out.
        cut: of those asked for, the ones that a last limit changed or kept back.
        holes: times that the arm had no command of ours for more than one period.
        longest_hole_ms: the longest of them, from one command to the next.
        success_min, success_mean: share of our commands that the arm says had arrived in time;
            None where it says nothing.
    """

    sent: int = 0
    cut: int = 0
    holes: int = 0
    longest_hole_ms: float = 0.0
    success_min: float | None = None
    success_mean: float | None = None

    def line(self) -> str:
        """In one sentence; shares in percent."""
        said = f"{self.sent} commands, {self.cut} cut or kept back, {self.holes} holes"
        if self.holes:
            said += f" (the longest {self.longest_hole_ms:.0f} ms)"
        if self.success_min is None or self.success_mean is None:
            return said
        low, mean = 100.0 * self.success_min, 100.0 * self.success_mean
        return f"{said}; arrived in time: {mean:.1f} %, at worst {low:.0f} %"


@dataclass
class Intake:
    """What arrived from an arm and what became of it: received = used + refused.

    Attributes:
        received: messages that arrived: datagrams, joint replies, rows of a recording.
        used: of these, that went into samples.
        refused: the others, by reason.
        lost: messages that were sent (or due) and never arrived, as far as can be told.
        notes: one sentence for each kind of trouble, written at its first occurrence.
        commands: what went the other way; None where the driver does not count it.
    """

    received: int = 0
    used: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    notes: list[str] = field(default_factory=list)
    commands: CommandCount | None = None
    _noted: set[str] = field(default_factory=set, repr=False, compare=False)

    def note(self, kind: str, sentence: str) -> None:
        """Write a sentence at the first occurrence of its kind."""
        if kind not in self._noted:
            self._noted.add(kind)
            self.notes.append(sentence)

    def as_dict(self) -> dict[str, Any]:
        """As plain numbers and texts."""
        commands = None if self.commands is None else dict(vars(self.commands))
        told = {key: value for key, value in vars(self).items() if key != "_noted"}
        return {**told, "refused": dict(self.refused), "commands": commands}


def checked_torques(tau: Array, n: int) -> Array:
    """The torques of a command as float64. Raises DriverError for anything but n finite numbers."""
    wanted = np.asarray(tau, dtype=np.float64)
    if wanted.shape != (n,) or not np.isfinite(wanted).all():
        said = str(tau).replace("\n", " ")
        raise DriverError(f"a command is {n} finite torques in N m, got {said}; nothing was sent")
    return wanted


class Driver(Protocol):
    """A source of samples and, where it can move, a sink of torque commands.

    `read` returns the next sample. Where `paced` is true the source sets the rhythm and `read`
    blocks until its sample is there; otherwise the caller keeps the clock and `read` returns at
    once. Joint and link order are those of `joint_names` and `link_names`, which is
    empty where no motion of links is measured.
    """

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, in the order of every array."""

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the links whose motion is measured; () for none."""

    @property
    def period_ns(self) -> int:
        """Nominal time between two samples."""

    @property
    def paced(self) -> bool:
        """Whether the source sets the rhythm."""

    @property
    def can_move(self) -> bool:
        """Whether `command` moves anything."""

    @property
    def adds_gravity(self) -> bool:
        """Whether the arm carries its own weight; a command is then what comes on top of it."""

    @property
    def delay_ns(self) -> int:
        """From the instant of a sample to that at which a command given upon it has its effect.

        Feedback has to be gentler where it is long.
        """

    @property
    def intake(self) -> Intake:
        """The account of what arrived."""

    @property
    def arrived_ns(self) -> int:
        """CLOCK_MONOTONIC instant at which the last sample read had arrived at this machine.

        0 where time stands still between two reads (recordings, simulated arms).
        """

    def connect(self) -> None:
        """Open the connection. Raises DriverError."""

    def read(self) -> JointSample:
        """The next sample. Raises EndOfStream at the end of a recording, DriverError on faults."""

    def command(self, tau: Array) -> None:
        """Ask for (n,) joint torques, N m; gravity included unless the arm `adds_gravity`.

        Raises DriverError if it cannot, or for anything but n finite numbers.
        """

    def stop(self) -> None:
        """Bring the arm to a safe stand; may be called at any time and more than once."""

    def close(self) -> None:
        """Release the connection; may be called more than once."""


def _of_driver(name: str) -> Any:
    """An attribute that is the driver's own."""
    return property(attrgetter(f"driver.{name}"))


class PassedOn:
    """What stands before another driver and has its names, period, account and commands.

    Attributes:
        driver: the one behind.
    """

    joint_names, link_names = _of_driver("joint_names"), _of_driver("link_names")
    period_ns, delay_ns = _of_driver("period_ns"), _of_driver("delay_ns")
    paced, can_move = _of_driver("paced"), _of_driver("can_move")
    adds_gravity, intake = _of_driver("adds_gravity"), _of_driver("intake")
    arrived_ns = _of_driver("arrived_ns")
    # The driver's, where it is told what carries the arm; None where it is not.
    carry = property(lambda self: getattr(self.driver, "carry", None))

    def __init__(self, driver: Driver) -> None:
        self.driver = driver

    def command(self, tau: Array) -> None:
        """Pass (n,) N m on. Raises DriverError."""
        self.driver.command(tau)
