"""Forward simulation along a recording, restarted from the data again and again.

A segment starts from the recorded motion: what the sensors read is taken back to the links, the
arm is put there and then follows the drives' torque alone. What comes out is again what the
sensors would read, so that the recording can be held against it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from adapter import optional
from adapter.errors import ModelError, SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.simulate.arm import SimulatedArm
from adapter.simulate.in_mujoco import MujocoArm
from adapter.simulate.in_pybullet import PybulletArm
from drivers.errors import choices

STEP_S = 1e-3  # longest step
UNEVEN = 1e-3  # of a period: what a table's times may lack of a whole number of steps
SIMULATORS: Mapping[str, Callable[..., SimulatedArm]] = {
    "pybullet": PybulletArm,
    "mujoco": MujocoArm,
}


class DrivenMotion(NamedTuple):
    """How an arm moved and what drove it.

    Attributes:
        t: (m,) s, uniform.
        q, dq: (m, n) measured, smoothed, rad and rad/s.
        u: (m, n) driving torque, N m.
    """

    t: Array
    q: Array
    dq: Array
    u: Array


# (model, motion, segments, drive) -> simulated q, dq (m, n), NaN outside the segments and all
# over where the model cannot be simulated
Simulate = Callable[[SelfModel, DrivenMotion, Sequence[tuple[int, int]], str], tuple[Array, Array]]


class Rollouts:
    """Simulates self models along recordings; a `Simulate`.

    Args:
        simulator: one of `SIMULATORS`.

    Attributes:
        simulator: its name.
        troubles: why models could not be simulated, a sentence each.

    Raises:
        SettingsError: there is no such simulator. MeansError: it is not installed.
    """

    def __init__(self, simulator: str = "pybullet") -> None:
        if simulator not in SIMULATORS:
            raise SettingsError(f"no simulator '{simulator}'; {choices(simulator, SIMULATORS)}")
        optional.load(simulator)
        self.simulator, self.troubles = simulator, list[str]()

    def __call__(
        self,
        model: SelfModel,
        motion: DrivenMotion,
        segments: Sequence[tuple[int, int]],
        drive: str,
    ) -> tuple[Array, Array]:
        """Simulated q, dq (m, n) as the encoders read them.

        Args:
            model: with its effects.
            motion: recorded.
            segments: rows [start, stop) each.
            drive: "commands", u is the driving torque; "measured", u is what sensors read of it.
        """
        out = np.full((2, *motion.q.shape), np.nan)
        period_s = float(motion.t[-1] - motion.t[0]) / (len(motion.t) - 1)
        steps = max(int(np.ceil(period_s / STEP_S - UNEVEN)), 1)
        try:
            arm = SIMULATORS[self.simulator](model, None, period_s / steps)
        except ModelError as error:
            trouble = f"no forward simulation: {error}"
            if trouble not in self.troubles:
                self.troubles.append(trouble)
            return out[0], out[1]
        try:
            t, effects = motion.t, arm.effects
            u = effects.driving(t, motion.u) if drive == "measured" else motion.u
            q, dq = effects.links(t, motion.q, motion.dq, u)
            middles = (np.arange(steps) + 0.5) / steps
            for start, stop in segments:
                now = float(t[start])
                arm.place(q[start], dq[start], now)
                effects.settle(q[start], dq[start], u[start], now, motion.q[start])
                for k in range(start, stop):
                    out[:, k] = effects.measured(*arm.state(), u[k], float(t[k]))[:2]
                    for part in middles if k + 1 < stop else ():
                        arm.step(u[k] + part * (u[k + 1] - u[k]))
        finally:
            arm.close()
        return out[0], out[1]
