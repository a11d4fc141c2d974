"""How far the motion that a learned λ predicts lies from the measured one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from adapter.errors import ModelError
from adapter.kinematics import DTYPE, link_motion
from adapter.offline.finite import check_finite, check_motion
from adapter.offline.moments import CHANNELS
from adapter.spatial import Array
from adapter.tree_data import TreeData

CHUNK = 4096  # samples propagated at a time: 30 links' motion then takes 12 MB
# Edges of the histogram: decades of |k - k_hat| from rounding to gross.
EDGES: Array = np.asarray(10.0 ** np.arange(-18, 5), dtype=np.float64)


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
    lam_t = torch.as_tensor(lam, dtype=DTYPE)
    for start in range(0, len(data), CHUNK):
        part = data.take(slice(start, start + CHUNK))
        assert part.links is not None
        with torch.no_grad():
            k = link_motion(data.tree, lam_t, *part.joint_signals(), part.base.torch())
        for name in channels:
            found = getattr(k, name)[:, int(data.tree.floating) :].numpy()
            gap = np.abs(found - getattr(part.links, name))
            worst[name] = np.maximum(worst[name], gap.max(axis=(0, 2)))
            counts[name] += np.histogram(np.clip(gap, EDGES[0], EDGES[-1] * 0.999), EDGES)[0]
    largest = {name: float(by_link.max()) for name, by_link in worst.items()}
    return KinematicErrors(largest, counts, EDGES, worst)
