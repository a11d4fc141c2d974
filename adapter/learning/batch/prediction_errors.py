"""How far link motion and torques that learned λ and θ predict lie from the measured ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adapter.errors import ModelError
from adapter.learning.schema_kernels import CHANNELS
from adapter.learning.tree_data import TreeData, check_dynamics, check_finite, check_motion
from adapter.model.spatial import Array
from adapter.physics.kernels import frames_of, link_motions, torques

CHUNK = 4096  # samples propagated at a time: 30 links' motion then takes 12 MB
# Edges of the histogram: decades of |k - k_hat| from rounding to gross.
EDGES: Array = np.asarray(10.0 ** np.arange(-18, 5), dtype=np.float64)
LEAST_TORQUE = 0.1  # N m; the relative error of a smaller torque says nothing (our choice)
_PLACES = {"v": slice(0, 3), "w": slice(3, 6), "a": slice(6, 9), "dw": slice(9, 12)}


@dataclass(frozen=True)
class KinematicErrors:
    """|k - k_hat| over samples, links and components, by channel w, v, a, dw.

    Attributes:
        largest: by channel, in rad/s, m/s, m/s², rad/s²; channels not measured are missing.
        histogram: by channel, counts per decade between `edges`; smaller errors count in the
            first bin, larger ones in the last.
        edges: of the bins.
        largest_by_link: by channel (n,).
    """

    largest: dict[str, float]
    histogram: dict[str, np.ndarray]
    edges: Array
    largest_by_link: dict[str, Array]


def kinematic_errors(data: TreeData, lam: Array) -> KinematicErrors:
    """Errors of the motion of all links, carried from the base down the tree with λ (n, 6).

    Raises:
        ModelError: no link motion to compare with, a λ of another shape, or numbers that are not
            finite.
    """
    if data.links is None:
        raise ModelError("kinematic errors need the links' measured motion, and none is given")
    if lam.shape != (data.tree.n, 6):
        raise ModelError(f"λ must have shape ({data.tree.n}, 6), got {lam.shape}")
    check_motion(data)
    check_finite({"λ": lam})
    with_speed = data.links.v is not None and data.base.v is not None
    channels = [name for name in CHANNELS if name != "v" or with_speed]
    worst = {name: np.zeros(data.tree.n) for name in channels}
    counts = {name: np.zeros(len(EDGES) - 1, dtype=np.int64) for name in channels}
    frames = frames_of(data.tree, lam)
    for start in range(0, len(data), CHUNK):
        part = data.take(slice(start, start + CHUNK))
        found = np.empty((*part.q.shape, 12))
        link_motions(frames, part.joints(), part.base.rows(), found)
        for name in channels:
            gap = np.abs(found[:, :, _PLACES[name]] - getattr(part.links, name))
            worst[name] = np.maximum(worst[name], gap.max(axis=(0, 2)))
            counts[name] += np.histogram(np.clip(gap, EDGES[0], EDGES[-1] * 0.999), EDGES)[0]
    largest = {name: float(by_link.max()) for name, by_link in worst.items()}
    return KinematicErrors(largest, counts, EDGES, worst)


def predicted_torques(data: TreeData, lam: Array, theta: Array) -> Array:
    """τ (m, rows) of λ (n, 6) and θ (bodies, 10) for the samples' motion, N m.

    Raises:
        ModelError: λ or θ of another shape, or numbers that are not finite.
    """
    wanted = (data.tree.n, 6), (data.tree.bodies, 10)
    if (lam.shape, theta.shape) != wanted:
        raise ModelError(f"λ and θ must have shapes {wanted}, got {lam.shape} and {theta.shape}")
    check_dynamics(data)
    check_finite({"λ": lam, "θ": theta})
    tau = np.empty(data.tau.shape)
    frames = frames_of(data.tree, lam)
    torques(frames, np.ascontiguousarray(theta), data.joints(), data.base.rows(), tau)
    return tau


def relative_errors(tau: Array, estimate: Array) -> Array:
    """Eq. 20 by sample and joint, (m, n), in 0 to 2; NaN where |tau| is at most `LEAST_TORQUE`.

    Raises:
        ModelError: tables of different shapes, or numbers that are not finite.
    """
    if tau.shape != estimate.shape or tau.ndim != 2:
        raise ModelError(f"torques {tau.shape} and estimates {estimate.shape} must be like tables")
    check_finite({"measured torque": tau, "estimated torque": estimate})
    judged = np.abs(tau) > LEAST_TORQUE
    larger = np.maximum(np.abs(tau), np.abs(estimate))
    error = np.abs(tau - estimate) / np.where(judged, larger, 1.0)
    return np.where(judged, error, np.nan)
