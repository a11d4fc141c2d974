"""The simulated arm as its robot controller sees it: sensors, own model, drives, brakes.

And what a client can set of it: end effector, load, stiffness, collision thresholds; with ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.interface import DriverError, JointSample
from sim.dynamics import compiled, cross, end_effector
from sim.effects import payload
from sim.fci.cartesian import difference, impedance, posture
from sim.fci.codec import JOINTS, TICK_S, Request, Status
from sim.plant import Plant
from sim.rigid_bodies import payload_theta
from sim.scenarios import Scenario
from sim.truth import FLANGE, Array

# Ranges: Franka FCI documentation.
FILTER_HZ = (1.0, 1000.0)
STIFFNESS = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)  # N m/rad, libfranka examples
# Thresholds before a client sets any: chosen here, above what excitation with a hand needs.
TORQUE_THRESHOLD = (40.0, 40.0, 36.0, 36.0, 10.0, 10.0, 10.0)  # N m
FORCE_THRESHOLD = (80.0, 80.0, 80.0, 40.0, 40.0, 40.0)  # N, N m
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
    cartesian_stiffness: Array = field(default_factory=lambda: np.repeat([3000.0, 300.0], 3))
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
        if (x < 0).any() or (x > 14250.0).any():  # N m/rad
            return False
        self.stiffness = x
        return True

    def _SetCartesianImpedance(self, x: Array) -> bool:
        lowest, highest = np.repeat(np.array(((10.0, 3000.0), (1.0, 300.0))), 3, axis=0).T
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
        wrong = not 0.0 <= x[0] <= 10.0 or moments[0] < 0  # kg
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


# The joint impedance controller is scaled by the arm's inertia. 60 1/s, that of the plant's brakes,
# is what a command per millisecond holds stable on a rigid arm.
FASTEST_RATE = 60.0  # 1/s


class Arm:
    """Plant and internal model: the true arm and its motors' inertia, without later payloads and
    without friction.

    Attributes:
        truth: what the internal model knows.
        plant: the true arm.
        sample: the last sample of the sensors.
        q, dq: (7,) the true joint state at that instant, rad, rad/s.
        tau_external: (7,) low-passed measured minus model torque, N m: positive for what the
            robot exerts on its environment.
        wrench: (6,) the same at the stiffness frame, base axes; zero near singular postures.
        pose: (4, 4) of the end effector.
        jacobian: (6, 7) of its origin, base axes.
    """

    def __init__(self, scenario: Scenario, settings: Settings) -> None:
        self.truth = scenario.truth.with_changes(effects=())  # all that the robot knows
        self._motors = scenario.truth.motor_inertia
        self.plant: Plant = scenario.plant(substeps=2)  # four take too long on a slow machine
        self._n = self.truth.n
        self._still = np.zeros(self._n)
        self.refresh(settings)
        self.sample: JointSample = self.plant.read()
        self.q, self.dq, self._drive = self._state()
        self.tau_external: Array = np.zeros(self._n)
        self.wrench: Array = np.zeros(6)
        self._look()
        self.step()  # whatever is compiled on first use is compiled before the clock runs
        self.mass(self.q)
        self.reach(self.q, self.pose, np.nan)
        self._spring(self.pose, np.zeros(6), np.ones(6))

    @property
    def outside(self) -> bool:
        """A joint is outside its range."""
        limits = self.truth.limits
        return bool((self.q < limits.lower).any() or (self.q > limits.upper).any())

    def refresh(self, settings: Settings) -> None:
        """Take over what a client set: end effector, stiffness frame and load."""
        self._tool, self._to_K = FLANGE @ settings.F_T_EE, settings.EE_T_K
        theta = self.truth.theta.copy()
        m, com, inertia = settings.load
        if m > 0.0:
            theta[-1] += payload_theta(payload(m, FLANGE[:3, 3] + com, inertia))
        self._loaded = self.truth.with_changes(theta=theta)

    def drive(self, tau: Array) -> None:
        """Torques on top of gravity, reached at the end of the next tick; brakes open."""
        wanted = tau + self.model(self.q, self._still, self._still)
        try:
            self.plant.command(wanted)
        except DriverError:  # the plant's own guard: a joint is out of range or too fast
            self.plant.stop()

    def track(self, q: Array, dq: Array, ddq: Array, stiffness: Array) -> None:
        """Follow a joint motion by impedance control: no steady error without external torque."""
        M = self.mass(self.q)
        rate = np.minimum(np.sqrt(stiffness / np.diag(M)), FASTEST_RATE)
        push = ddq + rate * rate * (q - self.q) + 2 * rate * (dq - self.dq)
        self.drive(self.model(self.q, self.dq, push) - self.model(self.q, self._still, self._still))

    def comply(
        self, pose: Array, twist: Array, path: tuple[Array, Array, Array], stiffness: Array
    ) -> None:
        """Hold the end effector to a pose (4, 4) and twist (6,) by a Cartesian spring.

        Args:
            pose, twist: wanted, base axes.
            path: q, dq, ddq (7,) each, of which the posture counts where it leaves the end alone.
            stiffness: (6,) N/m and N m/rad.
        """
        q, dq, ddq = path
        tau, rest = self._spring(pose, twist, stiffness)
        inner = FASTEST_RATE**2 / 16 * (q - self.q) + FASTEST_RATE / 2 * (dq - self.dq)
        tau = tau + rest @ (self.mass(self.q) @ inner) + self.model(self.q, self.dq, ddq)
        self.drive(tau - self.model(self.q, self._still, self._still))

    def _spring(self, pose: Array, twist: Array, stiffness: Array) -> tuple[Array, Array]:
        error, rate = difference(self.pose, pose), twist - self.jacobian @ self.dq
        M = self.mass(self.q)
        return impedance(M, self.jacobian, error, rate, stiffness, FASTEST_RATE)

    def release(self) -> bool:
        """Let the drives act again after a violation; False while a joint is out of its range."""
        if self.outside:
            return False
        self.plant.fault = None
        return True

    def step(self) -> None:
        """One tick of the world; then look at the sensors."""
        q, dq, drive = self.q, self.dq, self._drive
        self.sample = self.plant.read()
        self.q, self.dq, self._drive = self._state()
        middle = (q + self.q) / 2, (dq + self.dq) / 2, (self.dq - dq) / TICK_S
        sensed = self.sample.tau + (drive - self._drive) / 2  # brought to the tick's middle
        outside = sensed - self.model(*middle)
        share = 1.0 - np.exp(-2 * np.pi * 10.0 * TICK_S)  # a low pass of 10 Hz
        self.tau_external += share * (outside - self.tau_external)
        self._look()

    def model(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (7,) of the internal model for a motion, N m."""
        return np.asarray(self._loaded.torques(q, dq, ddq) + self._motors * ddq)

    def mass(self, q: Array) -> Array:
        """(7, 7) mass matrix of the internal model, kg m²."""
        M = self._loaded.mass_matrix(q)
        M.flat[:: self._n + 1] += self._motors
        return M

    def frame(self, q: Array) -> tuple[Array, Array]:
        """Pose (4, 4) of the end effector and Jacobian (6, 7) at a posture."""
        return end_effector(self.truth.frames, q, self._tool)

    def reach(self, q: Array, pose: Array, elbow: float) -> tuple[Array, float]:
        """The joints (7,) nearest to q that bring the end effector to a pose, and what they miss.

        `elbow`, rad, is what joint 3 shall be; NaN for anything.
        """
        return posture(self.truth.frames, self._tool, q, np.ascontiguousarray(pose), elbow)

    def _state(self) -> tuple[Array, Array, Array]:
        """True q, dq and driving torque, each in one piece of memory: one compiled variant."""
        q, dq, drive = self.plant.link_state()
        return np.ascontiguousarray(q), np.ascontiguousarray(dq), drive

    def _look(self) -> None:
        """Pose and external wrench at the present posture."""
        self.pose, self.jacobian = self.frame(self.q)
        least = 0.01  # manipulability (m³, Yoshikawa) that a wrench takes; 0.08 when ready
        self.wrench = wrench_at(self.pose, self.jacobian, self._to_K, self.tau_external, least)


@compiled
def wrench_at(pose: Array, jacobian: Array, tool: Array, torque: Array, least: float) -> Array:
    """Wrench (6,) [f; m] at a frame whose joint torques come nearest to `torque`, base axes.

    Args:
        pose: (4, 4) of the end effector.
        jacobian: (6, n) of its origin.
        tool: (4, 4), the frame in the end effector; the wrench acts at its origin.
        torque: (n,) N m.
        least: manipulability, the root of det(J J^T), below which there is no telling: zeros.
    """
    J, lever, shift = jacobian.copy(), np.zeros(3), np.empty(3)
    for i in range(3):
        for k in range(3):
            lever[i] += pose[i, k] * tool[k, 3]
    for j in range(J.shape[1]):
        cross(J[3:, j], lever, shift)
        for i in range(3):
            J[i, j] += shift[i]
    square = J @ J.T
    wrench = np.zeros(6)
    if np.linalg.det(square) >= least * least:
        wrench[:] = np.linalg.solve(square, J @ torque)
    return wrench
