"""What an arm looks like to the rest of the project: a sample, a protocol, an error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class DriverError(RuntimeError):
    """An arm, bus or recording cannot do what was asked; the message says what can be done."""


class EndOfStream(DriverError):
    """A finite source (a recording) has no further sample."""


@dataclass(frozen=True, slots=True)
class LinkMotion:
    """Motion of every moving link at one instant, each in its own link frame.

    Attributes:
        twist: (n, 6) velocity of the link-frame origin and angular velocity [v; w], m/s, rad/s.
        accel: (n, 6) [a; dw]: linear acceleration of the origin as an accelerometer there reads
            it (at rest +9.81 m/s² upwards) and angular acceleration, m/s², rad/s².
    """

    twist: Array
    accel: Array


@dataclass(frozen=True, slots=True)
class JointSample:
    """What the arm says of one instant.

    Attributes:
        stamp_ns: the instant, nanoseconds on the source's own clock.
        q: (n,) joint positions, rad.
        dq: (n,) joint velocities, rad/s.
        tau: (n,) link-side joint torques, gravity included, N m.
        links: measured motion of the links at the same instant, where the arm measures it.
    """

    stamp_ns: int
    q: Array
    dq: Array
    tau: Array
    links: LinkMotion | None = None


class Driver(Protocol):
    """A source of samples and, where it can move, a sink of torque commands.

    `read` returns the next sample. Where `paced` is true the source sets the rhythm and `read`
    blocks until its sample is there; otherwise the caller keeps the clock and `read` returns at
    once. Joint and link order are those of `joint_names` and `link_names`, of equal length.
    """

    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    period_ns: int
    paced: bool
    can_move: bool

    def connect(self) -> None:
        """Open the connection. Raises DriverError."""

    def read(self) -> JointSample:
        """The next sample. Raises EndOfStream at the end of a recording, DriverError on faults."""

    def command(self, tau: Array) -> None:
        """Ask for (n,) joint torques, N m, gravity included. Raises DriverError if it cannot."""

    def stop(self) -> None:
        """Bring the arm to a safe stand; may be called at any time and more than once."""

    def close(self) -> None:
        """Release the connection; may be called more than once."""
