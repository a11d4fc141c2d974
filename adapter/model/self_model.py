"""The self model S = {N, A, λ, θ} (paper, eq. 1), with what is known of how well it is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from adapter.errors import ModelError
from adapter.model.inertia import move_theta, theta_from_body
from adapter.model.numbers import plus_minus
from adapter.model.posterior import Doubt, Posterior, doubted, with_numbers
from adapter.model.spatial import Array, exp_rotation, matrix_from_zxz, zxz_from_matrix
from adapter.model.tree import Tree
from drivers.files.html_table import html_table

STANDARD_GRAVITY = 9.81  # m/s², the value simulators and Pinocchio use
LAMBDA_DOCUMENTATION = "documentation"
LAMBDA_REPRODUCED = "reproduces the documentation"
LAMBDA_MEASURED = "measured"
LAMBDA_SOURCES = (LAMBDA_DOCUMENTATION, LAMBDA_REPRODUCED, LAMBDA_MEASURED)
URDF, MJCF = "urdf", "mjcf"
LEAST_STD = 1e-9  # m, kg, kg m: of what data cannot show, rounding leaves less
_PULLS = ("mass · centre x, kg m", "y", "z")
LIMITS = ("lower", "upper", "velocity", "effort")


def gravity_down() -> Array:
    """Gravity [0 0 -9.81] m/s² of a base that stands upright."""
    return np.array([0.0, 0.0, -STANDARD_GRAVITY])


def _cell(value: float, std: float) -> str:
    """A value with its doubt; without one where there is none, or data show nothing of it."""
    return plus_minus(value, std if std > LEAST_STD else np.nan)


def effects_html(effects: Sequence[Mapping[str, Any]]) -> str:
    """A table of effects as a model file lists them, those of one kind together; empty of none.

    Args:
        effects: as `SelfModel.effects` has them.
    """
    rows: dict[tuple[str, str], list[str]] = {}
    for entry in effects:
        for key, value in entry["parameters"].items():
            if np.ndim(value):
                continue
            std = entry.get("std", {}).get(key)
            unit = entry.get("units", {}).get(key, "")
            cell = plus_minus(float(value), std)
            joints = ", ".join(map(str, entry["joints"])) or "all"
            rows.setdefault((entry["effect"], f"{key}, {unit}".rstrip(", ")), []).append(
                f"{joints}: {cell}"
            )
    if not rows:
        return ""
    lines = [(effect, what, "; ".join(cells)) for (effect, what), cells in rows.items()]
    return html_table("Effects", ("effect", "parameter", "joints: value ± std"), lines)


@dataclass(frozen=True)
class FixedFrame:
    """A frame that rides on a link: a flange, a sensor, a link that was merged into another.

    Attributes:
        name: of the frame (the URDF link).
        joint: name of the fixed (or locked) joint that carried it.
        parent: name of the moving link, or of the base, that it rides on.
        rotation: (3, 3) its orientation in the frame of `parent` (of this model).
        position: (3,) its origin there, m.
    """

    name: str
    joint: str
    parent: str
    rotation: Array
    position: Array


@dataclass(frozen=True)
class Tool:
    """A known load on a link; kept apart from θ, which describes the arm alone.

    Attributes:
        mass: kg, above zero.
        com: (3,) centre of mass in the frame of `link`, m.
        inertia: (3, 3) about the centre of mass, axes of `link`, kg m².
        link: the link that carries it; the last one where None.
    """

    mass: float
    com: Array
    inertia: Array
    link: str | None = None

    def theta(self) -> Array:
        """Its ten inertial parameters (10,) about the origin of its link's frame."""
        return theta_from_body(self.mass, self.com, self.inertia)


@dataclass(frozen=True)
class Source:
    """The file that describes the robot: what the model is written back onto.

    Attributes:
        format: `URDF` or `MJCF`.
        file: its name; of an MJCF, which may take in other files, the whole path.
        text: of a URDF; an MJCF is read from its file again.
        folder: that a URDF was read from, for its meshes; None where it came otherwise.
        lam: (n, 6) λ as documented there, row by row as in the model.
    """

    format: str
    file: str
    text: str | None = None
    lam: Array = field(default_factory=lambda: np.zeros((0, 6)))
    folder: str | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Limits:
    """Joint limits, (n,) each, NaN where unknown: rad, rad, rad/s, N m (m, m, m/s, N)."""

    lower: Array
    upper: Array
    velocity: Array
    effort: Array

    @classmethod
    def unknown(cls, n: int) -> Limits:
        """Limits of n joints of which nothing is known."""
        return cls(*(np.full(n, np.nan) for _ in LIMITS))


def check_limits(limits: Sequence[float], where: str) -> None:
    """Refuse a joint's [lower upper velocity effort] that no joint has; NaN is unknown.

    Raises:
        ModelError: beginning with `where`.
    """
    lower, upper, *most = limits
    if lower > upper:
        raise ModelError(f"{where}: its lower limit {lower:g} lies above its upper one {upper:g}")
    for key, value in zip(LIMITS[2:], most, strict=True):
        if value <= 0.0:
            raise ModelError(f"{where}: its {key} limit must be above zero, got {value:g}")


@dataclass(frozen=True)
class SelfModel:
    """What an arm knows about its own body.

    Link frames turn about their z (paper, eq. 9), or slide along it. A URDF joint of another axis
    has its frame turned by the smallest rotation from z to that axis (`spatial.z_to_axis`); `axis`
    keeps the original one, and `urdf_text` undoes the turn.

    Attributes:
        name: of the robot.
        tree: N, A and the names.
        lam: (n, 6) λ, rows [α β γ px py pz], rad and m (eq. 3b).
        theta: (bodies, 10) θ in the link frames; the base first with a floating base.
        limits: of the joints.
        axis: (n, 3) unit axes of the joints in the URDF's link frames.
        frames: what rides on the links.
        gravity: (3,) acceleration of gravity in base axes, m/s².
        base_theta: (10,) inertia of the base link, for a fixed base only (no torque shows it).
        tool: a known load, not part of `theta`.
        lam_std: (n, 6) standard deviations of each frame's turn (rotation vector, rad) and
            shift (m), both in the axes of the parent link; NaN where unknown.
        theta_std: (bodies, 10) standard deviations, of a learned θ those of what torques show
            of it (`identifiability.BaseParameters.shown_map`); NaN where unknown.
        lam_identifiable: (n, 6) bool, the same directions as `lam_std`; None where not judged.
        theta_identifiable: (bodies, 10) bool, the parameter alone; None where not judged.
        posterior: what is known of all that was learned together; None where nothing is beside
            the standard deviations.
        effects: one mapping each {effect, joints, parameters} with what goes along ({interval_s,
            std, units, evidence, ...}), JSON values only; what they mean, and whether they are
            right, `effects.active` knows.
        lambda_source: one of `LAMBDA_SOURCES`; λ from synthesized twists is never "measured".
        source: the robot's file, None where there is none.
        provenance: where the model came from, JSON values only.

    Raises:
        ModelError: shapes that don't fit the tree, non-finite λ, θ or gravity, unknown source.
    """

    name: str
    tree: Tree
    lam: Array
    theta: Array
    limits: Limits = None  # type: ignore[assignment]  # filled from the tree
    axis: Array = None  # type: ignore[assignment]
    frames: tuple[FixedFrame, ...] = ()
    gravity: Array = field(default_factory=gravity_down)
    base_theta: Array = field(default_factory=lambda: np.zeros(10))
    tool: Tool | None = None
    lam_std: Array = None  # type: ignore[assignment]
    theta_std: Array = None  # type: ignore[assignment]
    lam_identifiable: np.ndarray | None = None
    theta_identifiable: np.ndarray | None = None
    posterior: Posterior | None = None
    effects: tuple[Mapping[str, Any], ...] = ()
    lambda_source: str = LAMBDA_DOCUMENTATION
    source: Source | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, bodies = self.tree.n, self.tree.bodies
        defaults = {
            "limits": lambda: Limits.unknown(n),
            "axis": lambda: np.tile([0.0, 0.0, 1.0], (n, 1)),
            "lam_std": lambda: np.full((n, 6), np.nan),
            "theta_std": lambda: np.full((bodies, 10), np.nan),
        }
        for key, default in defaults.items():
            if getattr(self, key) is None:
                object.__setattr__(self, key, default())
        object.__setattr__(self, "effects", tuple(self.effects))
        self._check_arrays(n, bodies)
        if self.lambda_source not in LAMBDA_SOURCES:
            choices = ", ".join(f"'{s}'" for s in LAMBDA_SOURCES)
            raise ModelError(f"no lambda_source '{self.lambda_source}'; have: {choices}")
        links = (self.tree.base_name, *self.tree.link_names)
        riding = [(f"frame '{f.name}'", f.parent) for f in self.frames]
        if self.tool is not None and self.tool.link is not None:
            riding.append(("the tool", self.tool.link))
        for what, link in riding:
            if link not in links:
                raise ModelError(f"{what} rides on '{link}'; have: {', '.join(links)}")
        if self.tool is not None and not self.tool.mass > 0:
            raise ModelError(f"a tool's mass must be above zero, got {self.tool.mass}")
        if self.posterior is not None:
            self.posterior.check(n)
        if self.source is not None and np.shape(self.source.lam) != (n, 6):
            raise ModelError(f"source.lam must have shape {(n, 6)}, got {self.source.lam.shape}")

    def __repr__(self) -> str:
        return f"SelfModel({self.name}: {self.tree.n} joints, λ {self.lambda_source})"

    def _repr_html_(self) -> str:
        """Joints, links and effects, for notebooks; without ± what is documented or not shown."""
        heads = ("joint", "place in its parent, m", "link", "mass, kg", *_PULLS)
        first = self.tree.bodies - self.tree.n
        rows = [
            (
                joint,
                ", ".join(map(_cell, self.lam[j, 3:], self.lam_std[j, 3:])),
                self.tree.link_names[j],
                *map(_cell, self.theta[first + j, :4], self.theta_std[first + j, :4]),
            )
            for j, joint in enumerate(self.tree.joint_names)
        ]
        return html_table(repr(self), heads, rows) + effects_html(self.effects)

    def _check_arrays(self, n: int, bodies: int) -> None:
        known: dict[str, tuple[int, ...]] = {"lam": (n, 6), "theta": (bodies, 10), "axis": (n, 3)}
        known |= {"gravity": (3,), "base_theta": (10,)}
        maybe = {"lam_std": (n, 6), "theta_std": (bodies, 10)}
        for key, shape in {**known, **maybe}.items():
            value = np.array(getattr(self, key), dtype=np.float64)
            object.__setattr__(self, key, value)
            if value.shape != shape:
                raise ModelError(f"{key} must have shape {shape}, got {value.shape}")
            if key in known and not np.all(np.isfinite(value)):
                raise ModelError(f"{key} holds a value that is not finite")
        for key, shape in {"lam_identifiable": (n, 6), "theta_identifiable": (bodies, 10)}.items():
            flags = getattr(self, key)
            if flags is not None:
                object.__setattr__(self, key, np.array(flags, dtype=bool))
                if getattr(self, key).shape != shape:
                    raise ModelError(f"{key} must have shape {shape}, got {np.shape(flags)}")
        for key in LIMITS:
            if np.shape(getattr(self.limits, key)) != (n,):
                raise ModelError(f"limits.{key} must hold {n} values, one for each joint")
        tables = [getattr(self.limits, key) for key in LIMITS]
        for name, *row in zip(self.tree.joint_names, *tables, strict=True):
            check_limits([float(x) for x in row], f"joint '{name}'")

    @property
    def tool_link(self) -> str:
        """Name of the link that carries the tool."""
        named = self.tool.link if self.tool is not None else None
        return named if named is not None else self.tree.link_names[-1]

    def theta_with_tool(self) -> Array:
        """θ (bodies, 10) of the arm and its tool: what predicts the torques of the loaded arm."""
        theta = self.theta.copy()
        if self.tool is not None and self.tool_link in self.tree.body_names:
            theta[self.tree.body_names.index(self.tool_link)] += self.tool.theta()
        return theta

    def with_base(self, floating: bool) -> SelfModel:
        """The same robot on a free (True) or a fixed base; the base's inertia is not lost."""
        if floating == self.tree.floating:
            return self
        tree = replace(self.tree, floating=floating)
        unknown = np.full((1, 10), np.nan)
        if floating:
            theta = np.vstack([self.base_theta, self.theta])
            std, base = np.vstack([unknown, self.theta_std]), np.zeros(10)
        else:
            theta, std, base = self.theta[1:], self.theta_std[1:], self.theta[0]
        return replace(
            self, tree=tree, theta=theta, theta_std=std, base_theta=base, theta_identifiable=None
        )

    def sample(self, n: int = 1, seed: int = 0) -> list[SelfModel]:
        """Models drawn from what is known of this one; every body of theirs can exist.

        θ and the effects' numbers are drawn together, with the correlations that `posterior` has;
        without one each has its own standard deviation. What has none, and what no data showed,
        stays as it is; only where bodies could not exist otherwise, what no data showed gives way.
        Frames are drawn joint by joint beside them.

        Args:
            n: how many, from 1.
            seed: of the draws; the same one gives the same models.

        >>> import adapter
        >>> adapter.load_model("panda").sample(2)  # as documented: nothing is in doubt
        [SelfModel(panda: 7 joints, λ documentation), SelfModel(panda: 7 joints, λ documentation)]
        """
        rng = np.random.default_rng(seed)
        drawn = self.doubt().draws(n, rng)
        own = np.nan_to_num(self.lam_std)[..., None] * np.eye(6)
        roots = own if self.posterior is None else self.posterior.lam_root
        moved = np.einsum("jab,sjb->sja", roots, rng.standard_normal((n, *self.lam.shape)))
        turned = zxz_from_matrix(exp_rotation(moved[..., :3]) @ self.joint_rotation())
        lam = np.concatenate([turned, self.lam[:, 3:] + moved[..., 3:]], axis=2)
        lam = np.where(moved.any(axis=2, keepdims=True), lam, self.lam)
        return [
            replace(
                self.with_numbers(drawn[k]),
                lam=lam[k],
                lam_std=np.full(self.lam.shape, np.nan),
                theta_std=np.full(self.theta.shape, np.nan),
                posterior=None,
                provenance={**self.provenance, "sample": {"seed": seed, "number": k}},
            )
            for k in range(n)
        ]

    def doubt(self) -> Doubt:
        """What is known of θ and of the effects' numbers that have a standard deviation."""
        return Doubt.over(self.theta, self.theta_std, doubted(self.effects), self.posterior)

    def with_numbers(self, values: Array) -> SelfModel:
        """With other numbers (p,), in the order of `doubt`: θ, then those of effects."""
        theta, size = values[: self.theta.size].reshape(self.theta.shape), self.theta.size
        effects = with_numbers(self.effects, doubted(self.effects), values[size:])
        return replace(self, theta=theta, effects=effects)

    def joint_rotation(self) -> Array:
        """Orientation (n, 3, 3) of each link frame in its parent's at q = 0."""
        return matrix_from_zxz(self.lam[:, :3])


def theta_doubt(model: SelfModel) -> str:
    """What a learned model says against its θ, as that it had not converged; else nothing."""
    return str(model.provenance.get("theta_note", ""))


def base_inertia(model: SelfModel) -> Array:
    """Ten parameters (10,) of the base link, in its frame, whether it floats or not."""
    return model.theta[0] if model.tree.floating else model.base_theta


def turned_theta(theta: Array, rotation: Array) -> Array:
    """Ten parameters (10,) in axes turned about the same origin: R takes old axes to new."""
    return move_theta(theta, rotation, np.zeros(3))
