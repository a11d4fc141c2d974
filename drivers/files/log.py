"""A recording as an arm: its samples one after the other, as fast as they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap import read_log
from drivers.interface import Array, DriverError, EndOfStream, Intake, JointSample, LinkMotion

_DEFAULT_PERIOD_NS = 1_000_000  # of a recording too short to say


class LogArm:
    """Driver over a recording. Cannot move; `read` returns at once.

    Stamps, repeated samples and steps back in time come as they were recorded. Link motion comes
    with a sample when the recording has both twists and accelerations and any link has a message
    of that stamp; a link without one is then not a number.

    Args:
        path: an MCAP file, see `drivers.files.mcap.read_log`.
        joint_names: joints wanted, in this order; all where None.

    Raises:
        DriverError: the recording cannot be read or lacks a joint.

    Attributes:
        link_names: those that the recording pairs with the joints, else all; () where it has no
            link motion.
    """

    paced = False
    can_move = False
    adds_gravity = False
    arrived_ns = 0
    delay_ns = 0

    def __init__(self, path: str | Path, joint_names: Sequence[str] | None = None) -> None:
        self.log = log = read_log(path, joint_names)
        self.warnings: list[str] = log.warnings
        self.joint_names: tuple[str, ...] = log.joint_names
        # (m,) whether a sample has link motion; None where the recording has none to give
        self._has_links: NDArray[np.bool_] | None = None
        if log.twists is not None and log.accels is not None:
            self._has_links = ~np.all(np.isnan(log.twists) & np.isnan(log.accels), axis=(1, 2))
        elif log.twists is not log.accels:
            kind = "accelerations" if log.accels is None else "twists"
            self.warnings.append(f"{log.path}: no link {kind}; link motion is left out")
        self.link_names: tuple[str, ...] = log.link_names if self._has_links is not None else ()
        steps = np.diff(log.stamp_ns)
        steps = steps[steps > 0]
        self.period_ns = int(np.median(steps)) if steps.size else _DEFAULT_PERIOD_NS
        self._next: int | None = None
        self.intake = Intake()

    def __len__(self) -> int:
        return len(self.log)

    def connect(self) -> None:
        """Go to the first sample."""
        self._next, self.intake = 0, Intake()

    def read(self) -> JointSample:
        """The next sample. Raises EndOfStream behind the last, DriverError before `connect`."""
        if self._next is None:
            raise DriverError(f"{self.log.path}: not connected; call connect first")
        i, log = self._next, self.log
        if i >= len(log):
            raise EndOfStream(f"{log.path}: ends after {len(log)} samples")
        self._next = i + 1
        self.intake.received += 1
        self.intake.used += 1
        links = None
        if self._has_links is not None and self._has_links[i]:
            assert log.twists is not None and log.accels is not None
            links = LinkMotion(log.twists[i], log.accels[i])
        return JointSample(int(log.stamp_ns[i]), log.q[i], log.dq[i], log.tau[i], links)

    def command(self, tau: Array) -> None:
        """A recording cannot move. Raises DriverError."""
        raise DriverError(f"{self.log.path}: a recording takes no torque commands; use replay")

    def stop(self) -> None:
        """Nothing moves."""

    def close(self) -> None:
        """Leave the recording; `connect` starts it again."""
        self._next = None
