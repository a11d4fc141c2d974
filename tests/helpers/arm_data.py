"""Recordings of a moving arm for tests: Pinocchio's torques on smooth random motion, plus noise.

The truth comes from `sim`, the torques from Pinocchio's RNEA, so nothing here is the learner's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.signal import butter, sosfilt

from adapter.effects.torque import ModelTorque
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.learning.theta import Filtered, KnownArm
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.signals.front_end import FrontEnd
from adapter.signals.settings import FilterSettings
from drivers.files.mcap import Log
from drivers.interface import JointSample, LinkMotion
from sim.dynamics import link_motion
from sim.effects import Effect, per_joint
from sim.scenarios import build
from sim.truth import Truth, facts_of, panda

PERIOD_S = 1e-3
MIDDLE = np.array([0.0, 0.0, 0.0, -1.57, 0.0, 1.87, 0.0])  # rad
REACH = np.array([1.2, 0.8, 1.2, 0.8, 1.2, 0.9, 1.2])  # rad
SPEED = np.array([1.2, 1.2, 1.2, 1.2, 1.6, 1.6, 1.6])  # rad/s
LINK_TWIST_NOISE, LINK_ACCEL_NOISE = 2e-3, 2e-2
PIN_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]  # Pinocchio's inertias: XX XY YY XZ YZ ZZ


@dataclass(frozen=True)
class Motion:
    """A smooth random motion.

    Attributes:
        seconds: length; seed: of the sines; low_hz, high_hz: their band.
        rests: (from, to) s in which all joints stand, a ramp of a second at either end.
        alone: (joint, from s): from then on only this joint moves.
    """

    seconds: float
    seed: int = 0
    low_hz: float = 0.05
    high_hz: float = 1.0
    rests: tuple[tuple[float, float], ...] = ()
    alone: tuple[int, float] | None = None


@dataclass(frozen=True)
class ArmData:
    """Samples of an arm, (m,) and (m, n), and what is true of them."""

    truth: Truth
    stamp_ns: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    tau: np.ndarray
    true: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    twists: np.ndarray | None = None
    accels: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def part(self, seconds: float) -> ArmData:
        """The first so many seconds."""
        k = slice(round(seconds / PERIOD_S))
        fields = {x: getattr(self, x) for x in ("stamp_ns", "q", "dq", "tau", "twists", "accels")}
        cut = {key: None if value is None else value[k] for key, value in fields.items()}
        return replace(self, true=tuple(x[k] for x in self.true), **cut)  # type: ignore[arg-type]

    def samples(self) -> list[JointSample]:
        """One by one."""
        rows = zip(self.stamp_ns.tolist(), self.q, self.dq, self.tau, strict=True)
        if self.twists is None or self.accels is None:
            return [JointSample(*row) for row in rows]
        links = map(LinkMotion, self.twists, self.accels)
        return [JointSample(*row, link) for row, link in zip(rows, links, strict=True)]

    def log(self) -> Log:
        """As a recording in memory."""
        links = self.truth.link_names if self.twists is not None else ()
        names = self.truth.joint_names
        path = Path("arm_data.mcap")
        signals = (self.stamp_ns, self.q, self.dq, self.tau)
        return Log(path, names, *signals, links, self.twists, self.accels)


def pin_model(truth: Truth, payload: Effect | None = None) -> pin.Model:
    """A Pinocchio model built joint by joint from the truth's numbers, and what it carries."""
    model = pin_tree(range(-1, truth.n - 1), truth.R, truth.p, truth.theta, truth.gravity)
    if payload is not None:
        com = np.array([payload.number(key) for key in ("cx", "cy", "cz")])
        xx, xy, xz, yy, yz, zz = payload.parameters.get("inertia", [0.0] * 6)  # type: ignore[misc]
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = pin.Inertia(payload.number("m"), com, tensor)
        model.appendBodyToJoint(truth.n, body, pin.SE3.Identity())
    return model


def pin_tree(
    parent: Sequence[int],
    R: np.ndarray,
    p: np.ndarray,
    theta: np.ndarray,
    gravity: np.ndarray,
    free: bool = False,
) -> pin.Model:
    """A Pinocchio model built joint by joint, on a free base where asked for.

    Bodies θ are those of the links, or of a free base and the links.
    """
    model = pin.Model()
    model.gravity.linear = gravity
    joints = [0]
    if free:
        joints = [model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free")]
    for j, i in enumerate(parent):
        place = pin.SE3(R[j], p[j])
        joints.append(model.addJoint(joints[i + 1], pin.JointModelRZ(), place, f"j{j}"))
    for joint, body in zip(joints[-len(theta) :], theta, strict=True):
        inertia = pin.Inertia.FromDynamicParameters(body[PIN_ORDER])
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    return model


def free_answers(
    model: pin.Model, signals: Sequence[np.ndarray], base: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What Pinocchio says of a tree on a free base, in a world without gravity.

    Args:
        model: of `pin_tree`; signals: q, dq, ddq (m, n) of the joints; base: v, w, a, dw (m, 3) in
            its own axes, a without gravity, so that its pose is of no account.

    Returns:
        Base wrench and torques (m, 6 + n); v, w, a, dw (m, n, 4, 3) of the links; the largest
        force (m,) between two bodies.
    """
    data, numbers = model.createData(), range(2, model.njoints)
    places = [model.joints[k].idx_v for k in numbers]
    tau, motion, force = [], [], []
    for *joints, v, w, a, dw in zip(*signals, *base, strict=True):
        q, speed, accel = pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)
        q[[k + 1 for k in places]], speed[places], accel[places] = joints
        # Pinocchio's spatial acceleration of the free flyer: d/dt of [v; w] in body axes
        speed[:6], accel[:6] = [*v, *w], [*(a - np.cross(w, v)), *dw]
        found = pin.rnea(model, data, q, speed, accel)
        tau.append(np.concatenate([found[:6], found[places]]))
        force.append(max(np.linalg.norm(data.f[k].linear) for k in numbers))
        pin.forwardKinematics(model, data, q, speed, accel)
        rows = []
        for k in numbers:
            twist = data.v[k]
            felt = pin.getClassicalAcceleration(model, data, k, pin.LOCAL)
            rows.append(np.stack([twist.linear, twist.angular, felt.linear, felt.angular]))
        motion.append(np.stack(rows))
    return np.array(tau), np.array(motion), np.array(force)


def rnea(model: pin.Model, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Torques (m, n) of tables (m, n)."""
    data = model.createData()
    return np.array([pin.rnea(model, data, *row) for row in zip(q, dq, ddq, strict=True)])


def _step(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quintic step from 0 to 1 over x in [0, 1], with its two derivatives."""
    x = np.clip(x, 0.0, 1.0)
    value = x**3 * (10 - 15 * x + 6 * x**2)
    return value, 30 * x**2 * (1 - x) ** 2, 60 * x * (1 - x) * (1 - 2 * x)


def trajectory(motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, dq, ddq (m, n) of the motion."""
    rng = np.random.default_rng([motion.seed, 7])
    n, sines = len(MIDDLE), 5
    t = np.arange(round(motion.seconds / PERIOD_S)) * PERIOD_S
    w = 2 * np.pi * rng.uniform(motion.low_hz, motion.high_hz, (sines, n))
    size = rng.normal(size=(sines, n)) / np.sqrt(w)
    phase = rng.uniform(0, 2 * np.pi, (sines, n))
    q, dq, ddq = (np.zeros((len(t), n)) for _ in range(3))
    for a, k, f in zip(size, w, phase, strict=True):
        angle = np.outer(t, k) + f
        q, dq = q + a * np.sin(angle), dq + a * k * np.cos(angle)
        ddq = ddq - a * k * k * np.sin(angle)
    share = np.minimum(REACH / np.abs(q).max(axis=0), SPEED / np.abs(dq).max(axis=0))
    q, dq, ddq = q * share, dq * share, ddq * share
    # (3, m, n): share of the motion of each joint that is on, and its two derivatives
    n = len(MIDDLE)
    env = np.repeat(np.array(_step(t))[:, :, None], n, axis=2)
    for begin, end in motion.rests:
        env -= np.subtract(_step(t - begin), _step(t - end))[:, :, None]
    if motion.alone is not None:
        joint, begin = motion.alone
        others = np.arange(n) != joint
        env[:, :, others] -= np.array(_step(t - begin))[:, :, None]
    e, de, dde = env
    return MIDDLE + e * q, de * q + e * dq, dde * q + 2 * de * dq + e * ddq


def torques(truth: Truth, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """What a perfect sensor reads (m, n), payloads from their time on."""
    t = np.arange(len(q)) * PERIOD_S
    tau = rnea(pin_model(truth), q, dq, ddq)
    for effect in truth.effects:
        if effect.name == "payload":
            late = t > effect.start_s
            tau[late] = rnea(pin_model(truth, effect), q[late], dq[late], ddq[late])
    for effect in truth.effects:
        j = effect.columns(truth.n)
        if effect.name == "viscous_friction":
            tau[:, j] += effect.number("Fv") * dq[:, j]
        elif effect.name == "coulomb_friction":
            tau[:, j] += effect.number("Fc") * np.tanh(dq[:, j] / 0.01)
        else:
            assert effect.name == "payload", effect.name
    return tau


def _joint_noise(m: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noise (m, n) of q, dq and tau as on a real Panda's log (`sim/models/panda.toml`)."""
    levels = facts_of("panda")["noise"]
    rng = np.random.default_rng([seed, 11])
    shape = (m, len(MIDDLE))
    sos = butter(2, [10, 40], "band", fs=1000, output="sos")
    band = sosfilt(sos, rng.normal(size=shape), axis=0)
    band *= np.asarray(levels["tau_10_to_40hz"]) / band.std(axis=0)
    tau = band + np.asarray(levels["tau_above_50hz"]) * rng.normal(size=shape)
    q = np.asarray(levels["q_above_50hz"]) * rng.normal(size=shape)
    return q, np.asarray(levels["dq_above_50hz"]) * rng.normal(size=shape), tau


@cache
def record(
    truth: Truth, motion: Motion, noisy: bool = True, links: bool = False, seed: int | None = None
) -> ArmData:
    """A recording of the truth in motion, kept for later calls.

    Args:
        noisy: with a real Panda's noise, and that of link sensors.
        links: whether link motion is measured.
        seed: of the noise; the motion's where None.
    """
    q, dq, ddq = true = trajectory(motion)
    tau = torques(truth, *true)
    stamps = 1_000_000 * np.arange(len(q), dtype=np.int64)
    twists = accels = None
    if links:
        rows = zip(q, dq, ddq, strict=True)
        found = np.array([link_motion(truth.frames, truth.base, *row) for row in rows])
        twists, accels = found[:, :, :2].reshape(-1, 7, 6), found[:, :, 2:].reshape(-1, 7, 6)
    clean = ArmData(truth, stamps, q, dq, tau, (*true, tau), twists, accels)
    if not noisy:
        return clean
    seed = motion.seed if seed is None else seed
    rng = np.random.default_rng([seed, 13])
    extra = _joint_noise(len(q), seed)
    if twists is not None and accels is not None:
        twists = twists + LINK_TWIST_NOISE * rng.normal(size=twists.shape)
        accels = accels + LINK_ACCEL_NOISE * rng.normal(size=accels.shape)
    q, dq, tau = (x + e for x, e in zip((q, dq, tau), extra, strict=True))
    step = np.asarray(facts_of("panda")["noise"]["tau_step"])
    tau = np.round(tau / step) * step
    return replace(clean, q=q, dq=dq, tau=tau, twists=twists, accels=accels)


def rubbing(Fc: float, Fv: float) -> Truth:
    """The documented Panda with the same friction in every joint."""
    n = len(MIDDLE)
    coulomb = per_joint("coulomb_friction", "Fc", n * [Fc])
    return panda().with_changes(effects=coulomb + per_joint("viscous_friction", "Fv", n * [Fv]))


@cache
def arm() -> Truth:
    """The documented Panda as the simulator knows it; one object, so that `record` is cached."""
    return panda()


@cache
def bent(seed: int) -> Truth:
    """A Panda whose frames are not the documented ones; one object a seed, likewise."""
    return build("bent_link", seed).truth


@cache
def panda_model() -> SelfModel:
    """The documented Panda as the adapter knows it."""
    return documented("panda")


def states_of(
    data: ArmData, model: SelfModel | None = None, settings: FilterSettings | None = None
) -> np.ndarray:
    """Filtered states (k, size) of a recording."""
    front_end = FrontEnd(model or panda_model(), settings)
    links = None
    if data.twists is not None and data.accels is not None:
        links = data.twists, data.accels
    return front_end.step_table(data.stamp_ns, data.q, data.dq, data.tau, links)


def learner_for(model: SelfModel | None = None, **settings: object) -> OnlineLearner:
    """A learner as `make_learner` builds it."""
    model = model or panda_model()
    front_end = FrontEnd(model)
    tool = None if model.tool is None else model.tool.theta()
    return OnlineLearner(
        model.tree,
        model.gravity,
        LearnerSettings(**settings),  # type: ignore[arg-type]
        Filtered(front_end.filter.noise_gain, front_end.delay_s),
        KnownArm(tool_theta=tool),
    )


def teach(learner: OnlineLearner, states: np.ndarray, rows: int = 4) -> OnlineLearner:
    """Learn from states, so many at a time where ADAM's way does not matter; 1: as live."""
    for k in range(0, len(states), rows):
        learner.step_table(states[k : k + rows])
    return learner


def model_torque(
    model: SelfModel,
    lam: np.ndarray,
    theta: np.ndarray,
    q: np.ndarray,
    dq: np.ndarray,
    ddq: np.ndarray,
) -> np.ndarray:
    """Torque (m, n) of λ (n, 6) and θ (n, 10) under the model's gravity; no tool, no effects."""
    bare = replace(model, lam=lam, theta=theta, tool=None, effects=())
    return ModelTorque(bare)(q, dq, ddq)


def rms(error: np.ndarray) -> np.ndarray:
    """Root of the mean square of each column."""
    return np.sqrt(np.mean(np.square(error), axis=0))
