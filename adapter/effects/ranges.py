"""How unsure the numbers of a model are, for those who train over a range of models."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.effects.active import with_bodies
from adapter.effects.catalogue import KNOWN
from adapter.effects.torque import ModelTorque
from adapter.errors import ModelError
from adapter.model.inertia import body_from_theta, six_from_tensor
from adapter.model.posterior import doubted
from adapter.model.self_model import SelfModel, turned_theta
from adapter.model.spatial import Array, z_to_axis

FORMAT = "panda-adapter/ranges"
INSTANTS, SPEED, ACCELERATION = 100, 0.5, 2.0  # random motion, rad/s and rad/s² (m/s, m/s²)
WHOLE_TURN = np.pi  # rad (or m) of a joint without limits
SMALL = 1e-3  # of a standard deviation, for slopes
EXPLAINED, MOST = 0.95, 8  # share of the torque's variance that directions are told for; how many
PARTS = {"mass": ("kg", slice(0, 1)), "com": ("m", slice(1, 4)), "inertia": ("kg m2", slice(4, 10))}


def ranges(model: SelfModel) -> dict[str, Any]:
    """What a file of ranges holds, JSON values: means, standard deviations, and directions.

    A direction is a change of many numbers at once by one standard deviation; what the directions
    have together is what makes torques unsure. Their order is that of the squared torque error
    over random motion inside of the joints' limits.

    Raises:
        ModelError: a floating base; a model of which nothing is in doubt.
    """
    model = with_bodies(model)
    if model.tree.floating:
        raise ModelError(f"{model.name}: its base floats; ranges are of fixed-base arms")
    doubt, table = model.doubt(), _Table(model)
    if not doubt.root.size:
        raise ModelError(f"{model.name} has no standard deviations; learn it with run or replay")
    rng, n = np.random.default_rng(0), model.tree.n
    low = np.where(np.isfinite(model.limits.lower), model.limits.lower, -WHOLE_TURN)
    high = np.where(np.isfinite(model.limits.upper), model.limits.upper, WHOLE_TURN)
    q = rng.uniform(low, high, (INSTANTS, n))
    motion = q, SPEED * rng.normal(size=q.shape), ACCELERATION * rng.normal(size=q.shape)
    numbers, torques = [], []
    for column in SMALL * doubt.root.T:
        ends = model.with_numbers(doubt.mean + column), model.with_numbers(doubt.mean - column)
        one, other = (table.of(end) for end in ends)
        numbers.append((one - other) / (2.0 * SMALL))
        one, other = (ModelTorque(end)(*motion) for end in ends)
        torques.append((one - other).ravel() / (2.0 * SMALL))
    slopes, errors = np.array(numbers), np.array(torques)
    ways, sizes, _ = np.linalg.svd(errors, full_matrices=False)
    share = sizes**2 / np.sum(sizes**2)
    count = min(int(np.searchsorted(np.cumsum(share), EXPLAINED)) + 1, MOST)
    directions = []
    for k in range(count):
        of_joint = np.sqrt(np.mean((ways[:, k] @ errors).reshape(INSTANTS, -1) ** 2, axis=0))
        told = {"torque_share": float(share[k]), "torque_nm": of_joint.tolist()}
        directions.append(told | table.written(slopes.T @ ways[:, k]))
    own = {f"{e} {key}": KNOWN[e].units()[key] for e, _, key in table.labels}  # of what turns
    return {
        "format": FORMAT,
        "version": 1,
        "model": model.name,
        "units": {key: unit for key, (unit, _) in PARTS.items()} | own,
        "mean": table.written(table.of(model)),
        "std": table.written(np.linalg.norm(slopes, axis=0)),
        "directions": directions,
    }


class _Table:
    """A model's numbers as simulators have them: ten by link, then the doubted ones of effects."""

    def __init__(self, model: SelfModel) -> None:
        self._tree = model.tree
        self.labels = [number.label for number in doubted(model.effects)]
        self._turns = [z_to_axis(axis) for axis in model.axis]

    def of(self, model: SelfModel) -> Array:
        """(10 n + e,) mass, centre, inertia about it, in the axes of the link in its file."""
        theta = np.array([turned_theta(*x) for x in zip(model.theta, self._turns, strict=True)])
        mass, com, tensor = body_from_theta(theta)
        bodies = np.column_stack([mass, com, six_from_tensor(tensor)])
        return np.concatenate([bodies.ravel(), [x.value for x in doubted(model.effects)]])

    def written(self, values: Array) -> dict[str, Any]:
        """By link and by joint, as the file has it."""
        tree, links = self._tree, {}
        for name, row in zip(tree.link_names, values[: 10 * tree.n].reshape(-1, 10), strict=True):
            parts = {key: row[at].tolist() for key, (_, at) in PARTS.items()}
            links[name] = {**parts, "mass": float(row[0])}
        joints: dict[str, dict[str, float]] = {}
        for (effect, joint, key), value in zip(self.labels, values[10 * tree.n :], strict=True):
            name = tree.joint_names[joint - 1] if joint else "all"
            joints.setdefault(name, {})[f"{effect} {key}"] = float(value)
        return {"links": links, "joints": joints}
