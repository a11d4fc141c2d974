"""A tree of rigid bodies in free fall, by PyBullet, sampled so that every sample is exact.

PyBullet steps by semi-implicit Euler: v' = v + h a(q, v, tau), then q' = q + h v'. The sample
(q_k, v_k, (v_{k+1} - v_k) / h, tau_k) therefore satisfies the equations of motion to rounding
error, at any step. That holds for the base too, where PyBullet integrates the velocity of its
centre of mass in world axes. The motion of its link frame follows from that by formula:
differencing the velocity of any other point would leave an error of order h.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import pybullet as bullet
from scipy.spatial.transform import Rotation

from sim.dynamics import Frames, compiled, link_motion
from sim.rigid_bodies import disconnect, load_urdf
from sim.truth import (
    Array,
    Limits,
    body_of,
    facts_of,
    from_rpy,
    joint_text,
    lam_of,
    link_text,
    principal,
    theta_of,
)

BASE = -1
BOUNDS = ("lower", "upper", "velocity", "effort")  # of a joint, as its facts name them


@dataclass(frozen=True, eq=False)
class TreeTruth:
    """Everything that decides how a simulated tree of rigid bodies moves; no friction, no drives.

    Attributes:
        name: of the robot.
        joint_names: n names.
        link_names: n names, link j moves with joint j.
        base_name: of the base link.
        parent: for each joint the index of the link it hangs on, -1 the base; parents come first.
        R: (n, 3, 3) orientation of joint frame j in its parent's frame at q_j = 0; axis z.
        p: (n, 3) its position there, m.
        theta: (n + 1, 10) [m mX mY mZ XX XY XZ YY YZ ZZ] about the link-frame origin, SI; the
            base first.
        limits: of the joints; none of their acceleration.
        gravity: (3,) acceleration of gravity in world axes, m/s².

    Raises:
        ValueError: a parent that does not come earlier, or shapes that do not fit.
    """

    name: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    base_name: str
    parent: tuple[int, ...]
    R: Array
    p: Array
    theta: Array
    limits: Limits
    gravity: Array

    def __post_init__(self) -> None:
        n = len(self.parent)
        shapes = (self.R.shape, self.p.shape, self.theta.shape, self.limits.lower.shape)
        if shapes != ((n, 3, 3), (n, 3), (n + 1, 10), (n,)):
            raise ValueError(f"{n} joints don't fit shapes {shapes} of R, p, theta, limits")
        if not len(self.joint_names) == len(self.link_names) == n:
            raise ValueError(f"{n} joints need {n} joint names and {n} link names")
        for k, i in enumerate(self.parent):
            if not BASE <= i < k:
                raise ValueError(f"joint {k} hangs on link {i}; have: -1 (the base) to {k - 1}")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.parent)

    @property
    def lam(self) -> Array:
        """λ (n, 6), see `lam_of`."""
        return lam_of(self.R, self.p)


def atlas() -> TreeTruth:
    """The humanoid ATLAS: 30 joints on a floating pelvis; facts in `sim/models/atlas.toml`."""
    facts = facts_of("atlas")
    base, joints = facts["base"], facts["joint"]
    links = [j["link"] for j in joints]
    place = {base["link"]: BASE} | {name: k for k, name in enumerate(links)}
    return TreeTruth(
        name=facts["robot"]["name"],
        joint_names=tuple(j["name"] for j in joints),
        link_names=tuple(links),
        base_name=base["link"],
        parent=tuple(place[j["parent"]] for j in joints),
        R=np.array([from_rpy(j["rpy"]) for j in joints]),
        p=np.array([j["xyz"] for j in joints]),
        theta=np.array([theta_of(x["mass"], x["com"], x["inertia"]) for x in (base, *joints)]),
        limits=Limits(
            **{key: np.array([j[key] for j in joints]) for key in BOUNDS},
            acceleration=np.full(len(joints), np.inf),
            slowing=None,
        ),
        gravity=np.array(facts["robot"]["gravity"]),
    )


RATE_HZ = 1000.0  # of simulation, controller and samples
PUSH = 1.0  # N m, by which the controller's designer feels a joint's inertia
BANDWIDTH = 2 * np.pi * 15.0  # rad/s, of the feedback on a joint whose neighbours are free
DAMPING = 1.0  # ratio, likewise
# A robot babbles: each joint follows a sum of sines of its own about its middle. Slow and smooth on
# purpose: a pure-feedback controller can follow it, joints of a humanoid use most of their range at
# up to the top speed, and torques come from the motion of limbs and not from jerks at joints.
SINES = 3  # per joint
LOW_HZ, HIGH_HZ = 0.15, 0.75  # a joint's frequencies are spread evenly over the band
RANGE_SHARE = 0.8  # of the joint's range, spanned at most; the rest is for the controller's error
# rad/s, and share of the joint's own limit; its motion gets smaller where it would be faster
TOP_SPEED, SPEED_SHARE = 4.0, 0.5
TUMBLE = 0.3  # rms angular velocity of the base at the start, rad/s per axis


def plan(limits: Limits, t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Wanted positions and velocities of all joints.

    Args:
        limits: of n joints.
        t: (m,) s.
        rng: all that is random comes from it.

    Returns:
        q (m, n) rad inside the limits and dq (m, n) rad/s.
    """
    n = len(limits.lower)
    edges = np.linspace(LOW_HZ, HIGH_HZ, SINES + 1)[:, None]
    rate = 2 * np.pi * (edges[:-1] + (edges[1:] - edges[:-1]) * rng.random((SINES, n)))
    phase = rng.uniform(0, 2 * np.pi, (SINES, n))
    size = rng.uniform(0.5, 1.0, (SINES, n)) * rate.min(axis=0) / rate
    q, dq = np.zeros((len(t), n)), np.zeros((len(t), n))
    for a, w, f in zip(size, rate, phase, strict=True):
        angle = np.outer(t, w) + f
        q += a * np.sin(angle)
        dq += a * w * np.cos(angle)
    half = RANGE_SHARE * (limits.upper - limits.lower) / 2
    fastest = np.minimum(TOP_SPEED, SPEED_SHARE * limits.velocity)
    scale = np.minimum(half / np.abs(q).max(axis=0), fastest / np.abs(dq).max(axis=0))
    return (limits.lower + limits.upper) / 2 + scale * q, scale * dq


@dataclass(frozen=True, eq=False)
class FallRecord:
    """Exact samples of a fall; row k of everything belongs to one instant.

    Attributes:
        q, dq, ddq: (m, n) rad, rad/s, rad/s².
        tau: (m, n) joint torques, N m.
        base_v: (m, 3) velocity of the base link's origin in base axes, m/s.
        base_w: (m, 3) angular velocity of the base in base axes, rad/s.
        base_a: (m, 3) acceleration of that origin minus gravity in base axes, m/s².
        base_dw: (m, 3) angular acceleration in base axes, rad/s².
    """

    q: Array
    dq: Array
    ddq: Array
    tau: Array
    base_v: Array
    base_w: Array
    base_a: Array
    base_dw: Array

    def links(self, truth: TreeTruth) -> Array:
        """Motion of all moving links, as ideal sensors at their frames would read it.

        (4, m, n, 3), every link in its own frame: the origin's velocity, m/s, the angular velocity,
        rad/s, the origin's acceleration minus gravity (what an accelerometer reads), m/s², and the
        angular acceleration, rad/s².
        """
        frames = Frames(np.array(truth.parent), truth.R, truth.p)
        base = np.stack((self.base_v, self.base_w, self.base_a, self.base_dw), axis=1)
        tables: Array = _link_motions(frames, base, self.q, self.dq, self.ddq)
        return tables.transpose(2, 0, 1, 3)


@compiled
def _link_motions(frames: Frames, base: Array, q: Array, dq: Array, ddq: Array) -> Array:
    """(m, n, 4, 3) link motion for tables (m, n) and base (m, 4, 3)."""
    out = np.empty((*q.shape, 4, 3))
    for k in range(len(q)):
        out[k] = link_motion(frames, base[k], q[k], dq[k], ddq[k])
    return out


class FreeFall:
    """A tree that falls: knows how to be put somewhere and to move on by one step."""

    def __init__(self, truth: TreeTruth) -> None:
        """Load the tree."""
        self.truth = truth
        self.h_s = 1.0 / RATE_HZ
        self._world = bullet.connect(bullet.DIRECT)
        self._within = {"physicsClientId": self._world}
        self._close = weakref.finalize(self, disconnect, [self._world])
        self._robot = load_urdf(_urdf(truth), self._world, fixed=False)
        count = bullet.getNumJoints(self._robot, **self._within)
        infos = [bullet.getJointInfo(self._robot, j, self._world) for j in range(count)]
        number = {info[1].decode(): info[0] for info in infos}
        self._joints = [number[name] for name in truth.joint_names]
        _, self._com, inertia = body_of(truth.theta[0])
        self._axes = principal(inertia)[1]
        bullet.setTimeStep(self.h_s, **self._within)
        bullet.setGravity(*truth.gravity.tolist(), **self._within)

    def place(self, q: Array, dq: Array, w: Array) -> None:
        """Put the tree at the origin, its base level.

        Args:
            q: (n,) rad.
            dq: (n,) rad/s.
            w: (3,) angular velocity of the base in world axes, rad/s; its centre is at rest.
        """
        at = (0.0, 0.0, 0.0)
        level = (0.0, 0.0, 0.0, 1.0)
        bullet.resetBasePositionAndOrientation(self._robot, at, level, **self._within)
        bullet.resetBaseVelocity(self._robot, at, w.tolist(), **self._within)
        for j, angle, speed in zip(self._joints, q.tolist(), dq.tolist(), strict=True):
            bullet.resetJointState(self._robot, j, angle, speed, **self._within)

    def step(self, tau: Array) -> None:
        """Move on by one step under torques (n,) N m."""
        motors = self._robot, self._joints, bullet.TORQUE_CONTROL
        bullet.setJointMotorControlArray(*motors, forces=tau.tolist(), **self._within)
        bullet.stepSimulation(**self._within)

    def joints(self) -> tuple[Array, Array]:
        """q (n,) rad and dq (n,) rad/s."""
        states = bullet.getJointStates(self._robot, self._joints, **self._within)
        both = np.array([state[:2] for state in states])
        return both[:, 0], both[:, 1]

    def base(self) -> Array:
        """(10,) as PyBullet has it: quaternion x y z w of the base's principal axes, velocity of
        its centre of mass and angular velocity in world axes."""
        _, turned = bullet.getBasePositionAndOrientation(self._robot, **self._within)
        v, w = bullet.getBaseVelocity(self._robot, **self._within)
        return np.array((*turned, *v, *w))

    def felt_inertia(self) -> Array:
        """(n,) kg m²: what each joint feels at mid range with all the others free.

        Each joint is pushed once; the tree may be anywhere afterwards.
        """
        limits, rest = self.truth.limits, np.zeros(self.truth.n)
        middle, felt = (limits.lower + limits.upper) / 2, np.empty(self.truth.n)
        for j in range(self.truth.n):
            self.place(middle, rest, np.zeros(3))
            push = rest.copy()
            push[j] = PUSH
            self.step(push)
            felt[j] = PUSH * self.h_s / self.joints()[1][j]
        return felt

    def record(self, q: Array, dq: Array, tau: Array, bases: Array) -> FallRecord:
        """The exact samples of a run of m steps.

        Args:
            q: (m + 1, n) rad; dq: (m + 1, n) rad/s; bases: (m + 1, 10), see `base`.
            tau: (m, n) N m.
        """
        v, w = bases[:, 4:7], bases[:, 7:]
        R = Rotation.from_quat(bases[:-1, :4]).as_matrix() @ self._axes.T

        def into_base(x: Array) -> Array:
            return np.asarray(np.einsum("kij,ki->kj", R, x))

        c, gravity = self._com, self.truth.gravity
        base_w = into_base(w[:-1])
        base_dw = into_base(np.diff(w, axis=0) / self.h_s)
        turning = np.cross(base_w, c)
        base_a = into_base(np.diff(v, axis=0) / self.h_s - gravity)
        return FallRecord(
            q=q[:-1],
            dq=dq[:-1],
            ddq=np.diff(dq, axis=0) / self.h_s,
            tau=tau,
            base_v=into_base(v[:-1]) - turning,
            base_w=base_w,
            base_a=base_a - np.cross(base_dw, c) - np.cross(base_w, turning),
            base_dw=base_dw,
        )

    def close(self) -> None:
        """Free the PyBullet client; may be called more than once."""
        self._close()


def babble(truth: TreeTruth, seconds: float, rng: np.random.Generator) -> FallRecord:
    """Let a tree fall for a while and babble, its joints under pure feedback.

    Torques are those of a position and velocity feedback on the wanted motion, cut at the joints'
    effort limits; it starts on the wanted motion.

    Args:
        truth: the tree.
        seconds: how long.
        rng: all that is random comes from it.

    Raises:
        RuntimeError: a joint left its range, or the simulation diverged.
    """
    m = round(seconds * RATE_HZ)
    want_q, want_dq = plan(truth.limits, np.arange(m) / RATE_HZ, rng)
    tumble = TUMBLE * rng.standard_normal(3)
    fall = FreeFall(truth)
    try:
        felt = fall.felt_inertia()
        stiff, damp = BANDWIDTH**2 * felt, 2 * DAMPING * BANDWIDTH * felt
        effort = truth.limits.effort
        q, dq = np.empty((m + 1, truth.n)), np.empty((m + 1, truth.n))
        tau, bases = np.empty((m, truth.n)), np.empty((m + 1, 10))
        fall.place(want_q[0], want_dq[0], tumble)
        for k in range(m):
            q[k], dq[k] = fall.joints()
            bases[k] = fall.base()
            wanted = stiff * (want_q[k] - q[k]) + damp * (want_dq[k] - dq[k])
            tau[k] = np.clip(wanted, -effort, effort)
            fall.step(tau[k])
        q[m], dq[m] = fall.joints()
        bases[m] = fall.base()
    finally:
        fall.close()
    inside = np.all((q >= truth.limits.lower) & (q <= truth.limits.upper), axis=0)  # NaN is not
    if not inside.all():
        names = ", ".join(np.asarray(truth.joint_names)[~inside])
        raise RuntimeError(
            f"{truth.name}: the feedback did not keep {names} in range; babble more slowly "
            "(high_hz, top_speed) or over a smaller share of the range"
        )
    return fall.record(q, dq, tau, bases)


def _urdf(truth: TreeTruth) -> str:
    """The tree as URDF that PyBullet reads without loss: inertial frames in principal axes."""
    names = (truth.base_name, *truth.link_names)
    parts = [
        link_text(name, *body_of(theta)) for name, theta in zip(names, truth.theta, strict=True)
    ]
    for j, (joint, link) in enumerate(zip(truth.joint_names, truth.link_names, strict=True)):
        parent = names[truth.parent[j] + 1]
        parts.append(joint_text(joint, (parent, link), (truth.p[j], truth.R[j])))
    return "\n".join([f'<robot name="{truth.name}">', *parts, "</robot>"])
