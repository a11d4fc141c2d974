"""What a motion of a documented arm has to keep, and whether its documentation says enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.effects.by_joint import DRUM_M
from adapter.errors import SettingsError
from adapter.model.robots import RobotFacts, facts_of
from adapter.model.self_model import Limits, SelfModel
from adapter.model.spatial import Array
from drivers.interface import Driver


@dataclass(frozen=True)
class MotionLimits:
    """What a motion has to keep, (n,) each: rad, rad/s, rad/s², rad/s³, N m, N m/s.

    Attributes:
        known: the arm, where it is known by name.
        joint_names: () where nobody has named them.
        slides: (n,) which joints do, whose limits are in m and N; () where none does.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    effort: Array
    torque_rate: Array
    known: RobotFacts | None = None
    joint_names: tuple[str, ...] = ()
    slides: tuple[bool, ...] = ()

    @classmethod
    def of(cls, model: SelfModel) -> MotionLimits:
        """Limits of a documented arm; modest ones where its documentation is silent.

        Of an arm that is known by name the vendor's limits hold, too.
        """
        n, known, limits = model.tree.n, facts_of(model), model.limits
        modest = np.where(model.tree.slides, DRUM_M, 1.0)
        if known is not None:
            vendor = known.model.limits  # fmax and fmin: one's number where the other has none
            limits = Limits(
                np.fmax(limits.lower, vendor.lower),
                np.fmin(limits.upper, vendor.upper),
                np.fmin(limits.velocity, vendor.velocity),
                np.fmin(limits.effort, vendor.effort),
            )
        return cls(
            limits.lower,
            limits.upper,
            np.where(np.isfinite(limits.velocity), limits.velocity, 1.0 * modest),
            5.0 * modest if known is None else known.acceleration,
            1000.0 * modest if known is None else known.jerk,
            np.where(np.isfinite(limits.effort), limits.effort, np.inf),
            np.full(n, 1000.0) if known is None else known.torque_rate,  # N m/s
            known,
            model.tree.joint_names,
            model.tree.slides,
        )

    @property
    def robot(self) -> str:
        """Name of the arm where it is known; empty elsewhere."""
        return "" if self.known is None else self.known.name

    def speed_between(self, low: Array, high: Array) -> Array:
        """Speed (n,) rad/s allowed everywhere between the positions low and high (n,)."""
        by_position = None if self.known is None else self.known.speed_by_position
        if by_position is None:
            return self.velocity
        speed: Array = np.minimum(self.velocity, by_position.between(low, high))
        return speed


def need_complete(model: SelfModel) -> None:
    """Refuse to move an arm whose limits are not all documented.

    Raises:
        SettingsError: naming each joint and what it lacks.
    """
    limits, lacks = model.limits, []
    for j, name in enumerate(model.tree.joint_names):
        wrong = [key for key in ("lower", "upper") if not np.isfinite(getattr(limits, key)[j])]
        if not wrong and limits.lower[j] >= limits.upper[j]:
            wrong = ["lower below upper"]
        wrong += [key for key in ("velocity", "effort") if not getattr(limits, key)[j] > 0.0]
        if wrong:
            lacks.append(f"{name} ({', '.join(wrong)})")
    if lacks:
        raise SettingsError(
            f"{model.name}: an arm that may be real moves only within documented limits, and "
            f"these joints lack some: {'; '.join(lacks)}. Write them into the robot's file: "
            '<limit lower="" upper="" velocity="" effort=""/> in rad, rad/s, N m (where it slides '
            "m, m/s, N), above zero; a joint that turns without end needs a range for this, too "
            "(type revolute)"
        )


def another_robot(driver: Driver, limits: MotionLimits) -> str:
    """What is wrong where an arm says it is another than the model's; empty elsewhere."""
    robot = getattr(driver, "robot", "")
    if not robot or robot == limits.robot:
        return ""
    model = f"of the robot {limits.robot}" if limits.robot else "of no robot that is known by name"
    return f"the arm says that it is the robot {robot}, the model is {model}; give --robot {robot}"


def need_same_robot(driver: Driver, limits: MotionLimits) -> None:
    """Refuse to move an arm by another's limits. Raises SettingsError naming both."""
    wrong = another_robot(driver, limits)
    if wrong:
        raise SettingsError(wrong)
