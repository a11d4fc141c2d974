"""What hypotheses are made of: the bodies that may be parents, and each link seen across a joint.

For link j moved by joint s, eqs. 8a-8d multiplied by Rz(q_s) read y = R0ᵀ z, where y is known from
link j and joint s, and z from the parent alone (and, for v and a, from the place p):

    w    Rz(q)(w_j - dq z)                       z = w_i
    dw   Rz(q)(dw_j - ddq z - dq w_j × z)        z = dw_i
    v    Rz(q) v_j                               z = v_i + w_i × p
    a    Rz(q) a_j                               z = a_i + (dw_i × + w_i × w_i ×) p
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.discovery.prepare import PreparedLog
from adapter.model.self_model import STANDARD_GRAVITY
from adapter.model.spatial import Array, skew

NO_JOINT = -1  # the link rides rigidly on its parent
REST_RATIO = 3.0  # a link at rest moves less than so many times its noise's variance
# A mean below this does not speak against rest: gravity, and the bias of a gyroscope.
MOST_BIAS = {"a": np.inf, "w": np.radians(3.0)}  # m/s², rad/s
LEVER_M = 0.4  # m, distance of two neighbouring frames for which noise of the turning counts
# Filtering and sampling are not quite the same for all signals: share of a signal that may be
# left over without meaning anything.
RELATIVE_FLOOR = 3e-3
ABSOLUTE_FLOOR = {"w": 1e-6, "dw": 1e-5, "v": 1e-7, "a": 1e-5}  # rad/s, rad/s², m/s, m/s²


@dataclass(frozen=True)
class Bodies:
    """Links, and after them a base at rest under gravity if nothing in the recording is it.

    Attributes:
        log: the signals.
        links: how many of the bodies are links.
        motion: for each channel (m, bodies, 3); links at rest are exactly at rest.
        noise: for each channel (bodies,) variances.
        floor: for each channel (links,) variance that no misfit of a link looks below.
        at_rest: (links,) bool.
        resting: (joints,) bool, whether a joint's speed shows nothing but noise.
        base: the link that carries all others, if that was said.
    """

    log: PreparedLog
    links: int
    motion: dict[str, Array]
    noise: dict[str, Array]
    floor: dict[str, Array]
    at_rest: np.ndarray
    resting: np.ndarray
    base: int | None = None

    @property
    def count(self) -> int:
        """Links, and the base that isn't in the recording."""
        return len(next(iter(self.noise.values())))

    @property
    def unseen_base(self) -> int | None:
        """Index of the base that no link is; None where a link at rest is the base."""
        return self.links if self.count > self.links else None

    @property
    def channels(self) -> tuple[str, ...]:
        """What was measured, angular first; what merely follows is not held against anything."""
        return self.log.measured

    def variance(self, channel: str, joints: np.ndarray) -> Array:
        """(links, joints, bodies) expected variance of one component of y - R0ᵀ z."""
        r, own = self.log, self.noise[channel]
        out = (
            own[: self.links, None, None] + own[None, None, :] + self.floor[channel][:, None, None]
        )
        size = np.mean(self.motion[channel][:, : self.links] ** 2, axis=(0, 2))
        none = joints == NO_JOINT
        at = np.where(none, 0, joints)
        turn = np.where(none, 0.0, r.joint_noise["q"][at])
        out = out + (2.0 / 3.0) * size[:, None, None] * turn[None, :, None]
        for name, speed in (("w", "dq"), ("dw", "ddq")):
            if name == channel:
                out = out + np.where(none, 0.0, r.joint_noise[speed][at])[None, :, None] / 3.0
        for name, by in (("v", "w"), ("a", "dw")):
            if name == channel:
                out = out + (2.0 / 3.0) * LEVER_M**2 * self.noise[by][None, None, :]
        return np.asarray(out)


def bodies_of(log: PreparedLog, base: int | None = None) -> Bodies:
    """The bodies of a recording; `base` is the link that is known to carry all others."""
    motion = {k: x.copy() for k, x in log.motion.items()}
    noise = {k: x.copy() for k, x in log.noise.items()}
    size = {k: np.mean(x**2, axis=(0, 2)) for k, x in motion.items()}
    floor = {k: (RELATIVE_FLOOR**2) * size[k] + ABSOLUTE_FLOOR[k] ** 2 for k in motion}
    links = len(log.link_names)
    at_rest = np.ones(links, dtype=bool)
    for k in motion:
        mean = motion[k].mean(axis=0)
        small = np.linalg.norm(mean, axis=1, keepdims=True) < MOST_BIAS.get(k, 0.0)
        x = motion[k] - np.where(small, mean, 0.0)
        at_rest &= np.mean(x**2, axis=(0, 2)) < REST_RATIO * noise[k] + ABSOLUTE_FLOOR[k] ** 2
    for k, x in motion.items():
        x[:, at_rest] = x[:, at_rest].mean(axis=0) if k == "a" else 0.0
        noise[k][at_rest] = 0.0
    if base is None and (links <= len(log.joint_names) or not at_rest.any()):
        for k, x in motion.items():
            still = np.zeros((len(x), 1, 3))
            if k == "a":
                still[..., 2] = STANDARD_GRAVITY
            motion[k] = np.concatenate([x, still], axis=1)
            noise[k] = np.append(noise[k], 0.0)
    speed = np.mean(log.dq**2, axis=0)
    resting = speed < REST_RATIO * log.joint_noise["dq"] + ABSOLUTE_FLOOR["w"] ** 2
    return Bodies(log, links, motion, noise, floor, at_rest, resting, base)


def turned(q: Array, x: Array) -> Array:
    """Rz(q) x for q (m, ...) and x (m, ..., 3)."""
    c, s = np.cos(q), np.sin(q)
    x0, x1, x2 = x[..., 0], x[..., 1], x[..., 2]
    return np.stack([c * x0 - s * x1, s * x0 + c * x1, x2 + 0 * c], axis=-1)


def across(bodies: Bodies, channel: str, link: int, joints: np.ndarray) -> Array:
    """y (m, joints, 3) of one link seen across each of the joints."""
    r = bodies.log
    none = joints == NO_JOINT
    at = np.where(none, 0, joints)
    q, dq, ddq = (np.where(none, 0.0, x[:, at]) for x in (r.q, r.dq, r.ddq))
    x = np.repeat(bodies.motion[channel][:, link, None], len(joints), axis=1)
    if channel == "w":
        x[..., 2] -= dq
    elif channel == "dw":
        w = bodies.motion["w"][:, link, None]
        x[..., 0] -= dq * w[..., 1]
        x[..., 1] += dq * w[..., 0]
        x[..., 2] -= ddq
    return turned(q, x)


def lever(motion: dict[str, Array], channel: str, body: int) -> Array:
    """(m, 3, 3): what a place is multiplied with in v ([w ×]) and a ([dw ×] + [w ×][w ×])."""
    turn = skew(motion["w"][:, body])
    return turn if channel == "v" else np.asarray(skew(motion["dw"][:, body]) + turn @ turn)
