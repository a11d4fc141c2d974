"""Servos in a robot's files: what of them are effects of the arm, and what are its drives.

A number that `ServoModel` gains stands here once: as an effect, which every format writes or says
that it cannot, or as what drives a joint.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from adapter.effects.robots import RobotText, robot_mjcf, robot_urdf
from adapter.errors import ModelError
from adapter.gap.phrases import numbered
from adapter.gap.servo_model import ServoModel
from adapter.model.mjcf_drives import Drives, Floor, with_drives
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm

EFFECTS = {  # by name: its parameter, and where the servos have it
    "coulomb_friction": ("Fc", "coulomb"),
    "viscous_friction": ("Fv", "viscous"),
    "motor_inertia": ("B", "armature"),
}


def with_servos(model: SelfModel, servos: ServoModel) -> SelfModel:
    """The arm whose joints have the servos' friction and armature, and no other effects."""
    joints = list(range(1, model.tree.n + 1))
    effects = [
        {"effect": name, "joints": joints, "parameters": {key: getattr(servos, at).tolist()}}
        for name, (key, at) in EFFECTS.items()
    ]
    return replace(model, effects=tuple(effects))


def drives_of(servos: ServoModel, model: SelfModel) -> Drives:
    """What moves the joints, as MuJoCo has it. Raises ModelError for servos without a gain."""
    if servos.is_ideal:
        raise ModelError("the servos are where their commands are: no gain to write; fit them")
    ground, floor = servos.ground, None
    if ground.root > 0.0:
        floor = Floor(*ground[:4], ground.root**2, ground.rubs)
    damping, n = servos.velocity_gain + servos.viscous, model.tree.n
    arm, still = RigidArm.of(model).changed(gravity=np.zeros(3)), np.zeros((n, n))
    own_inertia = np.diagonal(arm.torque(still, still, np.eye(n)))  # kg m², at zero
    return Drives(
        servos.position_gain,
        servos.velocity_gain,
        servos.torque_limit,
        servos.feeds_speed,
        damping / (own_inertia + servos.armature),
        servos.stiction,
        servos.slip,
        servos.delay_s,
        floor,
    )


def servo_mjcf(
    model: SelfModel, servos: ServoModel, onto: str | Path | None = None, alone: bool = True
) -> RobotText:
    """MJCF of an arm that follows position commands as its servos do.

    Args:
        onto, alone: as of `robot_mjcf`; actuators of a file that is written onto are written anew.

    Raises:
        ModelError: as of `robot_mjcf`; the servos are ideal; MuJoCo refuses the result.
    """
    holds = replace(servos, coulomb=servos.coulomb + servos.stiction)  # less what falls with speed
    written = robot_mjcf(with_servos(model, holds), onto, alone)
    file = None if written.onto is None else Path(written.onto)
    text, notes = with_drives(written.text, model, drives_of(servos, model), file)
    lacks = [
        f"the {what} of joint {numbered((np.flatnonzero(sizes) + 1).tolist())} is not in it: no "
        "field of MuJoCo's holds it; our own simulation has it"
        for what, sizes in (("dead band", servos.dead_band), ("backlash", servos.backlash))
        if sizes.any()
    ]
    return replace(written, text=text, notes=(*written.notes, *notes, *lacks))


def servo_urdf(
    model: SelfModel, servos: ServoModel, onto: str | Path | None = None, alone: bool = False
) -> RobotText:
    """URDF of an arm with what there is a place for: friction. Raises ModelError."""
    written = robot_urdf(with_servos(model, servos), onto, alone)
    note = "a URDF has no place for the servos' gains, delay and static friction; --mjcf has"
    return replace(written, notes=(*written.notes, note))
