"""Motor types with their full scales, and sets of seven for a simulated arm.

The simulated Panda needs 87 N m on joints 1 to 4 and 12 N m on joints 5 to 7, which no type has
as its full scale. Set `panda` takes the next larger types and has 100 and 12.5 N m written into
register 23, as an integrator would: half the torque step of the type's own 200 N m. Set
`panda_fitted` also has PMAX and VMAX written to what a Panda needs (4 rad, 4 rad/s): a third of
the angle step, an eighth of the speed step. Set `openarm` has the types of an OpenArm.
"""

from __future__ import annotations

from dataclasses import dataclass

from sim.damiao.codec import Scale


@dataclass(frozen=True)
class MotorType:
    """Facts of a motor type (openarm_can's table; gear and rated torque: Seeed Studio wiki).

    Attributes:
        name: of the type.
        scale: full scales as delivered; the last one is also the most torque it can give.
        gear: ratio, register 20.
        rated: torque that it can give for good, N m. Seeed Studio for the types of an OpenArm;
            for the larger ones 0.4 of the full scale, our choice.
    """

    name: str
    scale: Scale
    gear: float
    rated: float


DM4310 = MotorType("DM4310", Scale(12.5, 30.0, 10.0), 10.0, 3.0)
DM4340 = MotorType("DM4340", Scale(12.5, 10.0, 28.0), 40.0, 9.0)
DM6006 = MotorType("DM6006", Scale(12.5, 45.0, 20.0), 6.0, 8.0)
DM8009 = MotorType("DM8009", Scale(12.5, 45.0, 54.0), 9.0, 20.0)
DM10010L = MotorType("DM10010L", Scale(12.5, 25.0, 200.0), 10.0, 80.0)

Fitting = tuple[MotorType, Scale]  # a type and what is written into its registers 21 to 23

_WIDE, _WRIST = DM10010L.scale._replace(tmax=100.0), DM6006.scale._replace(tmax=12.5)
_OPENARM = (DM8009, DM8009, DM4340, DM4340, DM4310, DM4310, DM4310)

SETS: dict[str, tuple[Fitting, ...]] = {
    "panda": ((DM10010L, _WIDE),) * 4 + ((DM6006, _WRIST),) * 3,
    "panda_fitted": ((DM10010L, Scale(4.0, 4.0, 100.0)),) * 4
    + ((DM6006, Scale(4.0, 4.0, 12.5)),) * 3,
    "openarm": tuple((kind, kind.scale) for kind in _OPENARM),
}


def motor_set(name: str) -> tuple[Fitting, ...]:
    """The motors of a set, joint 1 first. Raises ValueError, naming the choices."""
    if name not in SETS:
        raise ValueError(f"no motors {name!r}; have: {', '.join(SETS)}")
    return SETS[name]
