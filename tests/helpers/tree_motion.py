"""A tree in smooth random motion, floating in free fall or on a still base, by Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from adapter.learning.tree_data import BodyMotion, TreeData
from adapter.model.spatial import z_to_axis
from adapter.model.urdf import model_from_urdf
from tests.helpers.robot_models import (
    frame_motion,
    link_text,
    pin_model,
    places_of,
    set_angles,
    text_of,
)


def in_motion(text: str, floating: bool, seconds: float, seed: int, rate_hz: float = 1e3) -> tuple:
    """The documented model of a URDF's text and samples of it, free of noise.

    In free fall the base feels no gravity, so Pinocchio's model has none; its base's acceleration
    is the one that leaves no wrench there.
    """
    model = model_from_urdf(text, floating=floating)
    oracle = pin_model(text, floating)
    data = oracle.createData()
    if floating:
        oracle.gravity = pin.Motion.Zero()
    gravity, n = oracle.gravity.linear.copy(), model.tree.n
    dt, m = 1.0 / rate_hz, round(seconds * rate_hz)
    # q, dq, ddq (m, n): three sines a joint, inside its limits
    rng = np.random.default_rng(seed)
    lower, upper = (np.clip(x, -np.pi, np.pi) for x in (model.limits.lower, model.limits.upper))
    middle, half = 0.5 * (lower + upper), np.minimum(0.45 * (upper - lower), 0.9)  # rad
    size = rng.dirichlet(np.ones(3), n) * half[:, None]
    omega = 2 * np.pi * rng.uniform(0.15, 0.9, (n, 3))
    angle = omega * (dt * np.arange(m))[:, None, None] + rng.uniform(0, 2 * np.pi, (n, 3))
    q = middle + (size * np.sin(angle)).sum(axis=2)
    dq = (size * omega * np.cos(angle)).sum(axis=2)
    ddq = -(size * omega**2 * np.sin(angle)).sum(axis=2)
    names = model.tree.joint_names
    numbers = [oracle.getJointId(name) for name in names]
    turns = [z_to_axis(axis) for axis in model.axis]
    base, links = np.zeros((m, 12)), np.zeros((m, n, 12))
    tau = np.zeros((m, model.tree.rows))
    places = places_of(oracle, names)
    full_q, full_v, full_a = pin.neutral(oracle), np.zeros(oracle.nv), np.zeros(oracle.nv)
    speed = 0.3 * np.random.default_rng(seed + 1000).normal(size=6)
    before = np.zeros(6)
    for k in range(m):
        set_angles(oracle, full_q, names, q[k])
        full_v[places], full_a[places] = dq[k], ddq[k]
        if floating:
            full_v[:6], full_a[:6] = speed, 0.0
            wrench = pin.rnea(oracle, data, full_q, full_v, full_a)[:6].copy()
            inertia = pin.crba(oracle, data, full_q)[:6, :6]
            full_a[:6] = -np.linalg.solve(inertia, wrench)
            speed = speed + dt * (1.5 * full_a[:6] - 0.5 * (before if k else full_a[:6]))
            before = full_a[:6].copy()
        torque = pin.rnea(oracle, data, full_q, full_v, full_a)
        pin.forwardKinematics(oracle, data, full_q, full_v, full_a)
        tau[k] = np.concatenate([torque[: tau.shape[1] - n], torque[places]])
        if floating:
            base[k] = frame_motion(oracle, data, 1, np.eye(3), gravity).ravel()
        for j, number in enumerate(numbers):
            links[k, j] = frame_motion(oracle, data, number, turns[j], gravity).ravel()
    if not floating:
        base[:, 6:9] = -gravity
    samples = TreeData(model.tree, q, dq, ddq, tau, _motion(base), _motion(links))
    return model, samples


def _motion(rows: np.ndarray) -> BodyMotion:
    v, w, a, dw = (np.ascontiguousarray(rows[..., k : k + 3]) for k in (0, 3, 6, 9))
    return BodyMotion(w, a, dw, v)


def with_noise(samples: TreeData, seed: int, scale: float = 1.0) -> TreeData:
    """Noise of usual parts on everything measured: encoder, gyro, accelerometer, torque."""
    rng = np.random.default_rng(seed)

    def noisy(x: np.ndarray, std: object) -> np.ndarray:
        return x + scale * std * rng.normal(size=x.shape)

    def moving(motion: BodyMotion) -> BodyMotion:
        v = None if motion.v is None else noisy(motion.v, 2e-3)
        return BodyMotion(noisy(motion.w, 2e-3), noisy(motion.a, 2e-2), noisy(motion.dw, 2e-2), v)

    tau = samples.tau.copy()
    joints = tau[:, tau.shape[1] - samples.tree.n :]
    joints += scale * 0.01 * joints.std(axis=0) * rng.normal(size=joints.shape)
    links = None if samples.links is None else moving(samples.links)
    signals = noisy(samples.q, 2e-5), noisy(samples.dq, 1e-3), noisy(samples.ddq, 2e-2)
    return TreeData(samples.tree, *signals, tau, moving(samples.base), links)


def random_tree_text(links: int, seed: int) -> str:
    """URDF of a tree of turning joints with random bodies, no limit wider than 2 rad."""
    rng = np.random.default_rng(seed)
    parts, names = [_link_text("base", rng)], ["base"]
    for k in range(links):
        parent = names[max(0, len(names) - 1 - int(rng.integers(0, 3)))]
        axis, xyz = rng.normal(size=3), 0.25 * rng.normal(size=3)
        rpy = rng.uniform(-3, 3, 3)
        parts.append(_link_text(f"l{k}", rng))
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
            f'<origin xyz="{text_of(xyz)}" rpy="{text_of(rpy)}"/><axis xyz="{text_of(axis)}"/>'
            '<limit lower="-2" upper="2" velocity="5" effort="50"/></joint>'
        )
        names.append(f"l{k}")
    return '<robot name="random">' + "".join(parts) + "</robot>"


def _link_text(name: str, rng: np.random.Generator) -> str:
    mass, points = float(rng.uniform(0.5, 5.0)), 0.1 * rng.normal(size=(3, 8))
    return link_text(name, mass, points.T, f'xyz="{text_of(0.1 * rng.normal(size=3))}"')
