"""Recordings of robots whose links carry sensors, for discovery: motion from Pinocchio, noise.

Names and orders are shuffled; what is true is handed along.
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from adapter.discovery import Discovery
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, matrix_from_zxz
from drivers.files.mcap import Log
from tests.helpers.arm_data import free_answers, pin_tree
from tests.helpers.robot_models import read_quietly, urdf_text

ENCODER_STEP = 2 * np.pi / 2**19  # rad
DQ_NOISE, V_NOISE, DW_NOISE, TAU_NOISE = 1e-3, 1e-3, 0.05, 0.1  # rad/s, m/s, rad/s², N m


@dataclass(frozen=True)
class Motion:
    """How the robot moves: sines of random frequency in every joint, and of a floating base.

    Attributes:
        seconds, rate_hz: length and sampling.
        still: joints (indices of the robot) that rest.
        alike: pairs of joints of which the second moves as the first.
        speed: rad/s, the most of a joint.
    """

    seconds: float = 10.0
    rate_hz: float = 500.0
    still: tuple[int, ...] = ()
    alike: tuple[tuple[int, int], ...] = ()
    speed: float = 1.5


@dataclass(frozen=True)
class Case:
    """A recording and the truth about it: (joint, link, parent or "base") names, recorded ones.

    Attributes:
        body: body of the robot (0 the base) by recorded link name.
        mounts: (rotation, place) of each body's sensor in its joint frame.
    """

    log: Log
    edges: frozenset[tuple[str, str, str]]
    root: str
    model: SelfModel
    body: dict[str, int] = field(default_factory=dict)
    mounts: tuple[tuple[np.ndarray, np.ndarray], ...] = ()


@cache
def robot(name: str) -> SelfModel:
    """The Panda on its fixed base or a free one ("free panda"), or ATLAS, whose test may skip."""
    if name == "atlas":
        return read_quietly(urdf_text(name), floating=True)
    return documented("panda").with_base(name == "free panda")


def _sines(rng: np.random.Generator, t: np.ndarray, n: int, speed: float) -> tuple[np.ndarray, ...]:
    """Value, rate and second rate (m, n) of sums of sines that start at rest."""
    value, rate, second = (np.zeros((len(t), n)) for _ in range(3))
    for _ in range(4):
        k = 2 * np.pi * rng.uniform(0.1, 1.0, n)
        a = rng.normal(size=n) / np.sqrt(k)
        phase = rng.uniform(0, 2 * np.pi, n)
        angle = np.outer(t, k) + phase
        value, rate = value + a * np.sin(angle), rate + a * k * np.cos(angle)
        second = second - a * k * k * np.sin(angle)
    share = speed / np.maximum(np.abs(rate).max(axis=0), 1e-9)
    return value * share, rate * share, second * share


def _moved(model: SelfModel, motion: Motion, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """q, dq, ddq, tau (m, n), twists and accels (m, 1 + n, 6), the base first."""
    t = np.arange(round(motion.seconds * motion.rate_hz)) / motion.rate_hz
    n = model.tree.n
    q, dq, ddq = _sines(rng, t, n, motion.speed)
    for first, second in motion.alike:
        for x in (q, dq, ddq):
            x[:, second] = x[:, first]
    for j in motion.still:
        q[:, j], dq[:, j], ddq[:, j] = q[0, j], 0.0, 0.0
    _, speed, change = _sines(rng, t, 6, 0.6 if model.tree.floating else 0.0)
    frames = matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:]
    arm = pin_tree(model.tree.parent, *frames, model.theta[-n:], np.zeros(3), free=True)
    (v, w), (dv, dw), turn = np.split(speed, 2, axis=1), np.split(change, 2, axis=1), np.eye(3)
    felt = dv + np.cross(w, v)
    for a, spin in zip(felt, w, strict=True):
        a -= model.gravity @ turn
        turn = turn @ exp_rotation(spin / motion.rate_hz)
    base = v, w, felt, dw
    tau, links, _ = free_answers(arm, (q, dq, ddq), base)
    seen = np.concatenate([np.stack(base, axis=1)[:, None], links], axis=1)
    twists, accels = (x.reshape(len(t), 1 + n, 6) for x in (seen[:, :, :2], seen[:, :, 2:]))
    return q, dq, ddq, tau[:, 6:], twists, accels


def anyhow(
    seed: int, bodies: Collection[int], count: int, *, turned: bool = True, shifted: bool = True
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Mountings (rotation, place in m) of `count` bodies, random for those named, else none."""
    rng = np.random.default_rng([seed, 29])
    mounts = []
    for b in range(count):
        axis, angle = rng.normal(size=3), rng.uniform(0.5, np.pi)
        place = rng.uniform(-0.15, 0.15, 3)
        own_turn = exp_rotation(axis / np.linalg.norm(axis) * angle)
        turn = own_turn if turned and b in bodies else np.eye(3)
        mounts.append((turn, place if shifted and b in bodies else np.zeros(3)))
    return tuple(mounts)


@lru_cache(8)  # kept for other noise, mountings or channels
def _drawn(
    name: str, motion: Motion, seed: int
) -> tuple[tuple[np.ndarray, ...], np.random.Generator]:
    """The motion of a seed, and its generator as that left it."""
    rng = np.random.default_rng([seed, 17])
    return _moved(robot(name), motion, rng), rng


def record(
    name: str,
    motion: Motion,
    seed: int,
    *,
    noise: float = 1.0,
    base: bool | None = None,
    parts: str = "ta",
    mounts: tuple[tuple[np.ndarray, np.ndarray], ...] = (),
) -> Case:
    """A shuffled recording of `robot(name)`.

    Args:
        noise: times that of real parts.
        base: whether the base's motion is in it; where None, if it floats.
        parts: "t" with twists, "a" with accelerations.
        mounts: (rotation, place) of the sensor of each body, the base first, in its joint frame.
    """
    (q, dq, _, tau, twists, accels), rng = copy.deepcopy(_drawn(name, motion, seed))
    model = robot(name)
    # what sensors mounted so see of motion given in joint frames (m, bodies, 6)
    twists, accels = twists.copy(), accels.copy()
    for b, (rotation, place) in enumerate(mounts):
        w, dw = twists[:, b, 3:].copy(), accels[:, b, 3:].copy()
        v = twists[:, b, :3] + np.cross(w, place)
        a = accels[:, b, :3] + np.cross(dw, place) + np.cross(w, np.cross(w, place))
        twists[:, b] = np.concatenate([v @ rotation, w @ rotation], axis=1)
        accels[:, b] = np.concatenate([a @ rotation, dw @ rotation], axis=1)
    root = np.sqrt(motion.rate_hz / 2)
    q = np.round(q / ENCODER_STEP) * ENCODER_STEP
    dq = dq + noise * DQ_NOISE * rng.normal(size=q.shape)
    tau = tau + noise * TAU_NOISE * rng.normal(size=q.shape)
    gyro, accelerometer = np.radians(0.007) * root, 150e-6 * 9.81 * root  # of so many per √Hz
    levels = [V_NOISE] * 3 + [gyro] * 3, [accelerometer] * 3 + [DW_NOISE] * 3
    twists = twists + noise * np.array(levels[0]) * rng.normal(size=twists.shape)
    accels = accels + noise * np.array(levels[1]) * rng.normal(size=accels.shape)
    n = model.tree.n
    logged = range(0 if (model.tree.floating if base is None else base) else 1, 1 + n)
    joints, links = rng.permutation(n), rng.permutation(logged)
    joint_name = {int(j): f"motor_{k}" for k, j in enumerate(joints)}
    link_name = {int(b): f"imu_{k}" for k, b in enumerate(links)}
    edges = frozenset(
        (joint_name[j], link_name[j + 1], link_name.get(i + 1, "base"))
        for j, i in enumerate(model.tree.parent)
    )
    log = Log(
        Path("discovery_data.mcap"),
        tuple(joint_name[int(j)] for j in joints),
        (1e9 / motion.rate_hz * np.arange(len(q))).astype(np.int64),
        q[:, joints],
        dq[:, joints],
        tau[:, joints],
        tuple(link_name[int(b)] for b in links),
        twists[:, links] if "t" in parts else None,
        accels[:, links] if "a" in parts else None,
    )
    body = {name: b for b, name in link_name.items()}
    return Case(log, edges, link_name.get(0, "base"), model, body, mounts)


TRUSTED = 0.9  # no wrong edge may have more confidence than that
RATE_HZ = 250.0
SHORT = Motion(seconds=4.0, rate_hz=RATE_HZ)


def confidences(found: Discovery) -> dict[tuple[str | None, str, str | None], float]:
    """Of the edges with a joint."""
    return {(e.joint, e.link, e.parent): e.confidence for e in found.edges if e.joint}
