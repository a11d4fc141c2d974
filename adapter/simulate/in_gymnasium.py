"""Effects in an environment of gymnasium that steps MuJoCo; needs the extra [gymnasium]."""

from __future__ import annotations

from typing import Any

import gymnasium

from adapter.model.self_model import SelfModel
from adapter.simulate.in_mujoco import MujocoArm


class WithEffects(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose arm moves with the effects of its learned model.

    `info["measured"]` of every step is what the arm's sensors would read, q, dq and tau (n,).

    Args:
        env: has MuJoCo's `model` and `data`, as gymnasium's own MuJoCo environments.
        model: learned; its joints are found by name.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], model: SelfModel) -> None:
        super().__init__(env)
        own: Any = env.unwrapped
        self.arm = MujocoArm(model, (own.model, own.data))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """The sensors forget, too."""
        self.arm.effects.reset()
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Any:
        """One step of the environment, of however many steps of MuJoCo."""
        with self.arm.acting():
            observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "measured": self.arm.measured()}
