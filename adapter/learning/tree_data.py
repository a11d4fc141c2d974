"""What a tree-structured robot measures: joint signals, its base's motion, its links' motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from adapter.errors import ModelError
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.kernels import JointMotion
from adapter.signals.records import KIND, STAMP, LinkMotionKind, StateLayout


@dataclass(frozen=True)
class BodyMotion:
    """Motion of one body (m, 3) or of several (m, bodies, 3), each in its own frame.

    Attributes:
        w: angular velocity, rad/s.
        a: acceleration of the frame's origin with gravity (an accelerometer there reads it), m/s².
        dw: angular acceleration, rad/s².
        v: velocity of the frame's origin, m/s; None where nothing measures it.
    """

    w: Array
    a: Array
    dw: Array
    v: Array | None = None

    def take(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> BodyMotion:
        """Some of the samples."""
        w, a, dw = (x[rows] for x in (self.w, self.a, self.dw))
        return BodyMotion(w, a, dw, None if self.v is None else self.v[rows])

    def rows(self) -> Array:
        """Motion rows [v w a dw] (..., 12); zero for a velocity that nothing measures."""
        v = np.zeros_like(self.w) if self.v is None else self.v
        return np.concatenate([v, self.w, self.a, self.dw], axis=-1)


@dataclass(frozen=True)
class TreeData:
    """Samples of a tree; row k of everything belongs to one instant.

    Attributes:
        tree: N and A.
        q, dq, ddq: (m, n) rad, rad/s, rad/s².
        tau: (m, rows) N m; with a floating base the wrench [f; m] on the base, in its frame,
            comes first (zero in free fall).
        base: motion of the base, (m, 3) each.
        links: measured motion of every moving link, (m, n, 3) each; None where not measured.

    Raises:
        ModelError: shapes that don't fit the tree or each other.
    """

    tree: Tree
    q: Array
    dq: Array
    ddq: Array
    tau: Array
    base: BodyMotion
    links: BodyMotion | None = None

    def __post_init__(self) -> None:
        m, n = len(self.q), self.tree.n
        wanted = {"q": (m, n), "dq": (m, n), "ddq": (m, n), "tau": (m, self.tree.rows)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ModelError(f"{name} must have shape {shape}, got {getattr(self, name).shape}")
        for name, motion, bodies in (("base", self.base, ()), ("links", self.links, (n,))):
            for part in () if motion is None else (motion.w, motion.a, motion.dw, motion.v):
                if part is not None and part.shape != (m, *bodies, 3):
                    raise ModelError(f"{name} must be {(m, *bodies, 3)}, got {part.shape}")

    def __len__(self) -> int:
        return len(self.q)

    def take(self, rows: slice | NDArray[np.intp] | NDArray[np.bool_]) -> TreeData:
        """Some of the samples, in this order."""
        q, dq, ddq, tau = (x[rows] for x in (self.q, self.dq, self.ddq, self.tau))
        links = None if self.links is None else self.links.take(rows)
        return TreeData(self.tree, q, dq, ddq, tau, self.base.take(rows), links)

    def states(self, first_ns: int = 0, period_ns: int = 1_000_000) -> Array:
        """As the online learner takes them: (m, size) states of `StateLayout`, one trajectory."""
        at = StateLayout(self.tree.n, self.tree.floating)
        out = at.new(len(self))
        stamps = first_ns + period_ns * np.arange(len(self), dtype=np.int64)
        out[:, STAMP] = stamps.view(np.float64)
        parts = [(at.q, self.q), (at.dq, self.dq), (at.ddq, self.ddq), (at.tau, self.tau)]
        parts += [(at.motion_q, self.q), (at.motion_dq, self.dq)]
        if self.tree.floating:
            parts.append((at.base, self.base.rows()))
        if self.links is not None:
            out[:, KIND] = LinkMotionKind.MEASURED
            parts.append((at.motion, self.links.rows().reshape(len(self), -1)))
        for part, signal in parts:
            out[:, part] = signal
        return out

    def joints(self) -> JointMotion:
        """q, dq, ddq as the kernels take them."""
        return JointMotion(*(np.ascontiguousarray(x) for x in (self.q, self.dq, self.ddq)))


def stacked(parts: Sequence[TreeData]) -> TreeData:
    """Several sets of samples of one tree, one after the other. Raises ModelError for none."""
    if not parts:
        raise ModelError("no samples to put together")

    def motion(all_of: Sequence[BodyMotion | None]) -> BodyMotion | None:
        some = [x for x in all_of if x is not None]
        if len(some) < len(all_of):
            return None
        speeds = [x.v for x in some if x.v is not None]
        v = np.concatenate(speeds) if len(speeds) == len(some) else None
        w, a, dw = (np.concatenate([getattr(x, k) for x in some]) for k in ("w", "a", "dw"))
        return BodyMotion(w, a, dw, v)

    base = motion([part.base for part in parts])
    assert base is not None
    q, dq, ddq, tau = (
        np.concatenate([getattr(p, k) for p in parts]) for k in ("q", "dq", "ddq", "tau")
    )
    return TreeData(parts[0].tree, q, dq, ddq, tau, base, motion([part.links for part in parts]))


def check_finite(tables: Mapping[str, Array | None]) -> None:
    """Arrays by name, with samples, joints or bodies along the first axis; None is passed over.

    Raises:
        ModelError: a number that is not finite; says of which table and in which row.
    """
    for name, table in tables.items():
        if table is None or np.isfinite(table).all():
            continue
        row = int(np.argwhere(~np.isfinite(table))[0][0])
        raise ModelError(
            f"{name} holds numbers that are not finite, row {row} the first; leave such samples out"
        )


def check_motion(data: TreeData) -> None:
    """What λ is learned from: joint signals, motion of base and links."""
    links = {} if data.links is None else _parts("links", data.links)
    check_finite(_joints(data) | _parts("base", data.base) | links)


def check_dynamics(data: TreeData) -> None:
    """What torques are predicted from: joint signals and the base's accelerometer and gyro."""
    base = _parts("base", data.base)
    check_finite(_joints(data) | {name: base[name] for name in ("base.w", "base.a", "base.dw")})


def _joints(data: TreeData) -> dict[str, Array | None]:
    return {"q": data.q, "dq": data.dq, "ddq": data.ddq}


def _parts(name: str, motion: BodyMotion) -> dict[str, Array | None]:
    return {f"{name}.{part.name}": getattr(motion, part.name) for part in fields(motion)}
