"""What a client can set: end effector, load, stiffness, collision thresholds; with its ranges."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sim.fci.codec import JOINTS, Request, Status
from sim.truth import Array

# Ranges: Franka FCI documentation.
STIFFEST = 14250.0  # N m/rad
CARTESIAN_STIFFNESS = ((10.0, 3000.0), (1.0, 300.0))  # N/m, N m/rad
FILTER_HZ = (1.0, 1000.0)
CARTESIAN_DEFAULT = (3000.0, 3000.0, 3000.0, 300.0, 300.0, 300.0)  # N/m, N m/rad, as the next
STIFFNESS = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)  # N m/rad, libfranka examples
# Thresholds before a client sets any: chosen here, above what excitation with a hand needs.
TORQUE_THRESHOLD = (40.0, 40.0, 36.0, 36.0, 10.0, 10.0, 10.0)  # N m
FORCE_THRESHOLD = (80.0, 80.0, 80.0, 40.0, 40.0, 40.0)  # N, N m
HEAVIEST_KG = 10.0  # no Franka arm carries half of it
RIGID = 1e-5  # so far R^T R may be from the identity
# Where the thresholds of collision begin in the payload, in numbers: the nominal phase counts,
# since the simulated robot does not tell phases of acceleration apart.
LOWER_TORQUE, UPPER_TORQUE, LOWER_FORCE, UPPER_FORCE = 14, 21, 40, 46


@dataclass
class Settings:
    """Present values; matrices are (4, 4) or (3, 3), vectors (3,), SI.

    Attributes:
        F_T_NE: nominal end effector in the flange (Desk's on a real robot): the flange itself.
        NE_T_EE: end effector in the nominal one.
        EE_T_K: stiffness frame in the end effector.
        load: mass (kg), centre (3,) in the flange (m), inertia (3, 3) about it (kg m²).
        stiffness: (7,) of the joint impedance controller, N m/rad.
        cartesian_stiffness: (6,) of the Cartesian one, base axes, N/m and N m/rad.
        lower_torque, upper_torque: (7,) contact and collision, N m.
        lower_force, upper_force: (6,) contact and collision, N and N m.
    """

    F_T_NE: Array = field(default_factory=lambda: np.eye(4))
    NE_T_EE: Array = field(default_factory=lambda: np.eye(4))
    EE_T_K: Array = field(default_factory=lambda: np.eye(4))
    load: tuple[float, Array, Array] = field(
        default_factory=lambda: (0.0, np.zeros(3), np.zeros((3, 3)))
    )
    stiffness: Array = field(default_factory=lambda: np.array(STIFFNESS))
    cartesian_stiffness: Array = field(default_factory=lambda: np.array(CARTESIAN_DEFAULT))
    lower_torque: Array = field(default_factory=lambda: np.array(TORQUE_THRESHOLD))
    upper_torque: Array = field(default_factory=lambda: np.array(TORQUE_THRESHOLD))
    lower_force: Array = field(default_factory=lambda: np.array(FORCE_THRESHOLD))
    upper_force: Array = field(default_factory=lambda: np.array(FORCE_THRESHOLD))

    @property
    def F_T_EE(self) -> Array:
        """(4, 4) end effector in the flange."""
        return np.asarray(self.F_T_NE @ self.NE_T_EE)

    def apply(self, request: Request) -> Status:
        """Take over a Set* request; the status to reply: ok or invalid argument."""
        if request.name == "SetGuidingMode":
            return Status.OK if set(request.payload) <= {0, 1} else Status.INVALID
        numbers = request.numbers()
        if not np.isfinite(numbers).all():
            return Status.INVALID
        taken: bool = getattr(self, f"_{request.name}")(numbers)
        return Status.OK if taken else Status.INVALID

    def _SetCollisionBehavior(self, x: Array) -> bool:
        lower, upper = x[LOWER_TORQUE:UPPER_TORQUE], x[UPPER_TORQUE : UPPER_TORQUE + JOINTS]
        forces = x[LOWER_FORCE:UPPER_FORCE], x[UPPER_FORCE : UPPER_FORCE + 6]
        if (x < 0).any() or (lower > upper).any() or (forces[0] > forces[1]).any():
            return False
        self.lower_torque, self.upper_torque = lower, upper
        self.lower_force, self.upper_force = forces
        return True

    def _SetJointImpedance(self, x: Array) -> bool:
        if (x < 0).any() or (x > STIFFEST).any():
            return False
        self.stiffness = x
        return True

    def _SetCartesianImpedance(self, x: Array) -> bool:
        lowest, highest = np.repeat(np.array(CARTESIAN_STIFFNESS), 3, axis=0).T
        if (x < lowest).any() or (x > highest).any():
            return False
        self.cartesian_stiffness = x
        return True

    def _SetFilters(self, x: Array) -> bool:
        return bool((x >= FILTER_HZ[0]).all() and (x <= FILTER_HZ[1]).all())

    def _SetEEToK(self, x: Array) -> bool:
        return self._take_pose("EE_T_K", x)

    def _SetNEToEE(self, x: Array) -> bool:
        return self._take_pose("NE_T_EE", x)

    def _SetLoad(self, x: Array) -> bool:
        inertia = x[4:].reshape(3, 3)
        moments = np.linalg.eigvalsh((inertia + inertia.T) / 2)
        wrong = not 0.0 <= x[0] <= HEAVIEST_KG or moments[0] < 0
        if wrong or np.abs(inertia - inertia.T).max() > RIGID:
            return False
        self.load = float(x[0]), x[1:4], inertia
        return True

    def _take_pose(self, name: str, x: Array) -> bool:
        pose = x.reshape(4, 4).T.copy()  # column-major on the wire
        R = pose[:3, :3]
        rigid = np.abs(R.T @ R - np.eye(3)).max() < RIGID and np.linalg.det(R) > 0
        if not rigid or not np.array_equal(pose[3], (0.0, 0.0, 0.0, 1.0)):
            return False
        setattr(self, name, pose)
        return True
