"""A recording as the workflow handles it: screened, in seconds, with what drives its simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.gap.smoothing import Smoothed, smooth_motion
from adapter.records import Array
from drivers.mcap_file import Log

COMMANDS, MEASURED = "commands", "measured"
STEP_S = 1e-3
COMMAND_DELAY_S = 1e-3  # a command answers a sample and is reached at the end of the next period
UNLIKE = 0.3  # of the measured torque's size: commands further off mean something else
FAR_S = 0.05  # a command older than that does not drive any more
EDGE_S = 0.3


@dataclass(frozen=True, eq=False)
class Recorded:
    """One recording.

    Attributes:
        name: of the file.
        t: (m,) s since its first sample, increasing; q, dq, tau: (m, n).
        command_t, commands: (k,) s and (k, n) N m; None where none were recorded.
        dq_late_s: how much later dq is than q.
        weight: whether the fit may use it.
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
            order = np.argsort(log.commands.stamp_ns, kind="stable")
            command_t = 1e-9 * (log.commands.stamp_ns[order] - start).astype(float)
            commands = log.commands.tau[order]
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

    def smoothed(self) -> Smoothed:
        """Splines through its motion."""
        return smooth_motion(self.t, self.q, self.dq, self.dq_late_s)

    def drive(self, t: Array) -> tuple[Array, str]:
        """Torque (m, n) that moved the arm at times t, and which of `COMMANDS`, `MEASURED` it is.

        Commands that are far from the measured torques (without gravity, of motors, positions)
        or that leave out parts of the time are no drive.
        """
        measured = np.column_stack([np.interp(t, self.t, column) for column in self.tau.T])
        if self.command_t is None or self.commands is None:
            return measured, MEASURED
        at = self.command_t + COMMAND_DELAY_S
        whole = at[0] < t[0] + FAR_S and at[-1] > t[-1] - FAR_S and np.diff(at).max() < FAR_S
        given = np.column_stack([np.interp(t, at, column) for column in self.commands.T])
        off = np.sqrt(np.mean((given - measured) ** 2)) / np.sqrt(np.mean(measured**2))
        if not whole or not np.isfinite(off) or off > UNLIKE:
            return measured, MEASURED
        return given, COMMANDS
