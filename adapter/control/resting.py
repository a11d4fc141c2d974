"""Whether an arm at rest holds what its model says: asked before the first motion.

    |tau_measured - g(q) - load(q)| <= band   for every joint and some load that a hand may carry

Friction, offsets and what a model is wrong by stay within a band of the effort limit; a load's
mass and first moment enter linearly, so the load that leaves least is a linear program. Another
robot or another mounting is off by the weight of whole links, also about axes that no load can
turn: about an axis along gravity, say.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from adapter.control.feedforward import ModelFeedforward
from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm

BAND_SHARE, LEAST_BAND = 0.1, 0.5  # of the effort limit, and N m: friction, offsets, model error
LOAD_SHARE = 1 / 3  # of the mass of the moving links, that may hang on a hand unsaid
LOAD_REACH_M = 0.35  # of its centre from the frame of the last link, along each axis


def check_resting_torque(model: SelfModel, q: Array, tau: Array) -> None:
    """Refuse an arm at rest that does not hold what its model says.

    Args:
        model: with gravity and tool.
        q: (n,) rad, at rest.
        tau: (n,) measured there, gravity included, N m.

    Raises:
        SettingsError: with the joint and the numbers.
    """
    if not (np.isfinite(q).all() and np.isfinite(tau).all()):
        raise SettingsError("the arm at rest does not measure every joint's position and torque")
    said = ModelFeedforward.of(model).unbent(q)
    effort = np.where(np.isfinite(model.limits.effort), model.limits.effort, 0.0)
    band = np.maximum(BAND_SHARE * effort, LEAST_BAND)
    heaviest = LOAD_SHARE * float(model.theta[:, 0].sum())
    loads = _load_columns(model, q)
    left = tau - said - loads @ _best_load(tau - said, loads, band, heaviest)
    j = int(np.argmax(np.abs(left) / band))
    if abs(left[j]) > band[j]:
        raise SettingsError(
            f"{model.tree.joint_names[j]} holds {tau[j]:+.1f} N m at rest where the model "
            f"{model.name} says {said[j]:+.1f}; {abs(left[j]):.1f} N m of it no load of up to "
            f"{heaviest:.1f} kg at the hand explains, and {band[j]:.1f} is what friction may be. "
            "Is it another robot (--robot), mounted otherwise (--gravity X Y Z), carrying more "
            "([tool] in --config) or leaning on something? --trust-model moves it all the same"
        )


def _load_columns(model: SelfModel, q: Array) -> Array:
    """Torque (n, 4 hands) per kg and kg m of a load on each link that carries no other."""
    n, still = model.tree.n, np.zeros((1, model.tree.n))
    Y = RigidArm.of(model).regressor(q[None], still, still)[0].reshape(n, n, 10)
    hands = [link for link in range(n) if link not in model.tree.parent]
    return Y[:, hands, :4].reshape(n, -1)


def _best_load(wanted: Array, loads: Array, band: Array, heaviest: float) -> Array:
    """Mass and first moment (4 hands) with which least is left, in units of the band."""
    count = loads.shape[1]
    scaled = loads / band[:, None]
    rows = [np.c_[sign * scaled, -np.ones(len(band))] for sign in (1.0, -1.0)]
    ends = [sign * wanted / band for sign in (1.0, -1.0)]
    for k in range(count):
        if k % 4:  # a first moment: at most the reach times its mass, to both sides
            for sign in (1.0, -1.0):
                row = np.zeros(count + 1)
                row[k], row[k - k % 4] = sign, -LOAD_REACH_M
                rows.append(row[None])
                ends.append(np.zeros(1))
    goal = np.r_[np.zeros(count), 1.0]
    bounds = [(0.0, heaviest) if k % 4 == 0 else (None, None) for k in range(count)]
    found = linprog(goal, np.vstack(rows), np.concatenate(ends), bounds=[*bounds, (0.0, None)])
    load: Array = np.zeros(count) if found.x is None else found.x[:count]
    return load
