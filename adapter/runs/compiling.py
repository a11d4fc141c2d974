"""Kernels are compiled on a machine's first run: said once, and done before anything is timed.

Numba keeps what it compiled beside the sources, or in the user's cache folder where those cannot
be written (NUMBA_CACHE_DIR names another place).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba.core import event

from adapter.model.self_model import SelfModel
from adapter.physics.kernels import base_at_rest
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.config import PipelineSettings, with_imus
from adapter.runs.pipeline import make_front_end
from adapter.runs.replay import ReplayOptions, replay
from drivers.files.mcap import Log
from drivers.interface import JointSample

TRIED_S, SWING_RAD = 3.0, 0.2  # of the motion that every kernel is tried on

Say = Callable[[str], None]


class _Announcer(event.Listener):
    """Says that something is compiled when the first kernel is."""

    def __init__(self, say: Say) -> None:
        self._say, self.compiled = say, 0

    def on_start(self, event: object) -> None:
        if not self.compiled:
            self._say("compiling for this machine, once; this takes about half a minute")
        self.compiled += 1

    def on_end(self, event: object) -> None:
        """Nothing to say."""


def announce_compiling(say: Say) -> _Announcer:
    """From now on, say once when a kernel has to be compiled."""
    announcer = _Announcer(say)
    event.register("numba:compile", announcer)  # none where a kernel comes from the cache
    return announcer


def compile_first(documented: SelfModel, settings: PipelineSettings, every: int, say: Say) -> None:
    """Compile what learning takes, where this machine has not yet, by learning a made-up motion.

    Args:
        documented: the arm; where its base floats, it is tried on one that rests.
        settings, every: of the learning to come.
        say: hears, once, that compiling takes place.
    """
    announcer = announce_compiling(say)
    settings = with_imus(settings, ())  # there are none in the made-up motion
    # Every joint swings about the middle of its range, each at a pace of its own
    n, limits = documented.tree.n, documented.limits
    period_s = settings.filter.period_s
    t = period_s * np.arange(round(TRIED_S / period_s), dtype=np.float64)[:, None]
    middle = np.nan_to_num(0.5 * (limits.lower + limits.upper))
    pace = 3.0 + 0.7 * np.arange(n, dtype=np.float64)
    q = middle + SWING_RAD * np.sin(pace * t)
    dq = SWING_RAD * pace * np.cos(pace * t)
    tau = RigidArm.of(documented).torque(q, dq, -(pace**2) * (q - middle))
    stamps = np.round(1e9 * t[:, 0]).astype(np.int64)
    base = np.tile(base_at_rest(documented.gravity)[:9], (len(t), 1))
    log = Log(Path("made up"), documented.tree.joint_names, stamps, q, dq, tau, base=base)
    make_front_end(documented, settings).step(
        JointSample(int(log.stamp_ns[0]), log.q[0], log.dq[0], log.tau[0])
    )
    if announcer.compiled:
        replay(log, documented, settings, ReplayOptions(every))
