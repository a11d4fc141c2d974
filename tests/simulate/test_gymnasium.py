"""The wrapper around an environment of gymnasium."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from adapter.simulate import MujocoArm
from sim.effects import Effect
from tests.simulate.test_effects import DQ, LOSSES, READY
from tests.simulate.test_rollouts import PANDA, model_with

gymnasium = pytest.importorskip("gymnasium")


class Reacher(gymnasium.Env):  # type: ignore[misc]
    """A Panda in MuJoCo under joint torques, four steps at a time."""

    def __init__(self) -> None:
        arm = MujocoArm(PANDA)
        self.model, self.data = arm.model, arm.data
        self.action_space = gymnasium.spaces.Box(-20.0, 20.0, (7,))
        self.observation_space = gymnasium.spaces.Box(-10.0, 10.0, (14,))

    def _seen(self) -> np.ndarray:
        return np.concatenate([self.data.qpos, self.data.qvel])

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = READY, DQ
        return self._seen(), {}

    def step(self, action: np.ndarray) -> Any:
        self.data.qfrc_applied[:] = action
        mujoco.mj_step(self.model, self.data, 4)
        return self._seen(), 0.0, False, False, {}


def test_an_environment_moves_and_reads_with_the_effects() -> None:
    from adapter.simulate.in_gymnasium import WithEffects

    model = model_with(*LOSSES, Effect("torque_offset", (2,), {"o": 0.5}))
    with_them, bare, own = WithEffects(Reacher(), model), Reacher(), MujocoArm(model)
    action = np.array([1.0, -20.0, 2.0, 18.0, 0.3, 1.8, 0.1])
    for env in (with_them, bare):
        env.reset(seed=1)
    own.put(READY, DQ)
    for _ in range(25):
        seen, _, _, _, info = with_them.step(action)
        plain, *_ = bare.step(action)
    for _ in range(100):
        own.advance(action + own.effects(*own.read(), None, action, own.data.time))
    np.testing.assert_allclose(seen[:7], own.read()[0], atol=1e-4)
    assert np.abs(seen - plain).max() > 0.05
    assert info["measured"][2][1] == pytest.approx(-20.0 + 0.5)
    assert mujoco.get_mjcb_passive() is None
