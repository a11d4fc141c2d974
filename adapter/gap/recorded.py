"""A recording as the workflow handles it: screened, in seconds, with what drives its simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adapter.gap.smoothing import Smoothed, smooth_motion
from adapter.records import Array
from drivers.mcap_file import Log

COMMANDS, MEASURED = "commands", "measured"
STEP_S = 1e-3
SAME_S, SAME_STEP_S = 0.05, 0.02  # of a repeat: so much longer or shorter; compared so often
SAME_RAD, SAME_RAD_S = 3e-4, 3e-3  # rms differences that are noise, no other motion
COMMAND_DELAY_S = 1e-3  # a command answers a sample and is reached at the end of the next period
UNLIKE = 0.3  # of the measured torque's size: commands further off mean something else
FAR_S = 0.05  # a command older than that does not drive any more
HOLE_S = 0.05  # between samples: what happened in there is not known
EDGE_S = 0.3


@dataclass(frozen=True, eq=False)
class Recorded:
    """One recording.

    Attributes:
        name: of the file.
        t: (m,) s since its first sample, increasing; q, dq, tau: (m, n).
        command_t, commands: (k,) s and (k, n) N m; None where none were recorded.
        dq_late_s: how much later dq is than q.
    """

    name: str
    t: Array
    q: Array
    dq: Array
    tau: Array
    command_t: Array | None = None
    commands: Array | None = None
    dq_late_s: float = 0.0

    @classmethod
    def of(cls, log: Log, dq_late_s: float = 0.0) -> Recorded:
        """From a screened log."""
        start = log.stamp_ns[0]
        command_t = commands = None
        if log.commands is not None and len(log.commands.stamp_ns) > 1:
            stamps, first = np.unique(log.commands.stamp_ns, return_index=True)
            known = np.isfinite(log.commands.tau[first]).all(axis=1)
            command_t = 1e-9 * (stamps[known] - start).astype(float)
            commands = log.commands.tau[first][known]
        t = 1e-9 * (log.stamp_ns - start).astype(float)
        return cls(log.path.name, t, log.q, log.dq, log.tau, command_t, commands, dq_late_s)

    def part(self, rows: slice) -> Recorded:
        """Some of its rows; times stay those of the whole."""
        return Recorded(
            self.name,
            self.t[rows],
            self.q[rows],
            self.dq[rows],
            self.tau[rows],
            self.command_t,
            self.commands,
            self.dq_late_s,
        )

    def repeated_in(self, others: Sequence[Recorded]) -> Recorded | None:
        """Another recording of the same motion, if one of these is."""
        return next((x for x in others if x is not self and self._repeats(x)), None)

    def _repeats(self, other: Recorded) -> bool:
        if abs(self.t[-1] - other.t[-1]) > SAME_S or abs(self.t[0] - other.t[0]) > SAME_S:
            return False
        span = max(self.t[0], other.t[0]), min(self.t[-1], other.t[-1])
        t = np.arange(span[0], span[1], SAME_STEP_S)
        mine, theirs = self.smoothed().at(t), other.smoothed().at(t)
        off = [np.sqrt(np.mean((a - b) ** 2)) for a, b in zip(mine, theirs, strict=True)]
        return bool(off[0] < SAME_RAD and off[1] < SAME_RAD_S)

    def smoothed(self) -> Smoothed:
        """Splines through its motion."""
        return smooth_motion(self.t, self.q, self.dq, self.dq_late_s)

    def grid(self) -> Array:
        """(m,) s, even times 1 ms apart within the recording, its edges left out."""
        span = self.t[-1] - self.t[0] - 2 * EDGE_S
        return self.t[0] + EDGE_S + STEP_S * np.arange(max(int(span / STEP_S), 0))

    def is_whole(self, begin_s: float, end_s: float) -> bool:
        """Whether there are samples all the way between two of its times."""
        first, last = np.searchsorted(self.t, (begin_s, end_s))
        around = self.t[max(first - 1, 0) : last + 1]
        return bool(len(around) > 1 and np.diff(around).max() < HOLE_S)

    def drive(self, t: Array) -> tuple[Array, str]:
        """Torque (m, n) that moved the arm at times t, and which of `COMMANDS`, `MEASURED` it is.

        Commands that are far from the measured torques (without gravity, of motors, positions)
        or that leave out parts of the time are no drive.
        """
        measured = np.column_stack([np.interp(t, self.t, column) for column in self.tau.T])
        given = self._commanded(t)
        if given is None:
            return measured, MEASURED
        size = float(np.sqrt(np.mean(measured**2)))
        off = float(np.sqrt(np.mean((given - measured) ** 2)))
        return (given, COMMANDS) if off < UNLIKE * size else (measured, MEASURED)

    def _commanded(self, t: Array) -> Array | None:
        """Commands (m, n) at times t; None where there are none for part of the time."""
        if self.command_t is None or self.commands is None or len(self.command_t) < 2:
            return None
        at = self.command_t + COMMAND_DELAY_S
        inside = at[(at > t[0] - FAR_S) & (at < t[-1] + FAR_S)] if len(t) else at[:0]
        if len(inside) < 2 or inside[0] > t[0] + FAR_S or inside[-1] < t[-1] - FAR_S:
            return None
        if np.diff(inside).max() > FAR_S:
            return None
        return np.column_stack([np.interp(t, at, column) for column in self.commands.T])
