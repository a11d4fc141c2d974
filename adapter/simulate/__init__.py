"""A learned model in a simulator: the effects that no robot file holds, step by step."""

from adapter.simulate.arm import SimulatedArm
from adapter.simulate.effects import FORMATS, Effects
from adapter.simulate.in_mujoco import MujocoArm
from adapter.simulate.in_pybullet import PybulletArm
from adapter.simulate.rollouts import SIMULATORS, DrivenMotion, Rollouts, Simulate

__all__ = [
    "FORMATS",
    "SIMULATORS",
    "DrivenMotion",
    "Effects",
    "MujocoArm",
    "PybulletArm",
    "Rollouts",
    "Simulate",
    "SimulatedArm",
]
