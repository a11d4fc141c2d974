"""Simulated falls as samples for learners, one trajectory at a time.

They are split as the paper does: shuffled train and test samples, and a control set.

Noisy signals become samples by one zero-phase filter for all, then differences. Offline nothing
needs to be causal: the same Butterworth low-pass runs forwards and backwards over every signal, so
all keep one and the same instant, and what is filtered alike stays consistent (the models are
linear in slow products of them). Accelerations are central differences of the filtered velocities.
The ends, where the filter has seen too little, are cut off.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from adapter.errors import ModelError
from adapter.learning.tree_data import BodyMotion, TreeData, stacked
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from sim.falls.data_set import FallData

# Section IV.A: 63 trajectories, 50 of them for training and test, the other 13 as control set.
PAPER_TRAJECTORIES, PAPER_TRAINED = 63, 50
TRAIN_SHARE = 0.75  # the paper's 75/25, read as 75 % train (reading notes)
LEARN_SHARE = 0.01  # of the training set, all that the FOP networks are given
LEAST_TRAJECTORIES = 5  # four to learn from and one as control set
SETS = ("train", "test", "control")


@dataclass(frozen=True)
class Split:
    """Which samples of which trajectory belong to which set.

    Attributes:
        lengths: samples of each trajectory of the train-and-test part.
        control: numbers of the control trajectories.
        train, test: rows in the trajectories of that part, one after the other; shuffled.
    """

    lengths: tuple[int, ...]
    control: tuple[int, ...]
    train: np.ndarray
    test: np.ndarray

    @property
    def learned(self) -> np.ndarray:
        """The rows that λ and θ are learned from."""
        return self.train[: round(LEARN_SHARE * len(self.train))]

    def rows_in(self, rows: np.ndarray, k: int) -> np.ndarray:
        """Those of the given rows that lie in trajectory k, counted from its start, in order."""
        start = sum(self.lengths[:k])
        return np.sort(rows[(rows >= start) & (rows < start + self.lengths[k])]) - start


def _used(count: int) -> int:
    """Trajectories for training and test of so many."""
    return round(count * PAPER_TRAINED / PAPER_TRAJECTORIES)


def learned_samples(count: int, length: int) -> int:
    """How many samples λ and θ are learned from, of `count` trajectories of `length` samples."""
    return round(LEARN_SHARE * round(TRAIN_SHARE * _used(count) * length))


def split(lengths: list[int], seed: int) -> Split:
    """Split trajectories of these lengths: about four fifths train and test, as the paper.

    Raises:
        ModelError: fewer than 5 trajectories.
    """
    count = len(lengths)
    if count < LEAST_TRAJECTORIES:
        needs = f"the experiment needs at least {LEAST_TRAJECTORIES} trajectories"
        raise ModelError(f"{needs}, got {count}")
    used = _used(count)
    order = np.random.default_rng(seed).permutation(sum(lengths[:used]))
    cut = round(TRAIN_SHARE * len(order))
    control = tuple(range(used, count))
    return Split(tuple(lengths[:used]), control, order[:cut], order[cut:])


class Falls:
    """Simulated trajectories as samples for learners."""

    def __init__(self, exact: FallData, noisy: FallData) -> None:
        self._exact, self.noisy = exact, noisy
        self.truth = truth = exact.truth
        self.tree = Tree(truth.parent, True, truth.joint_names, truth.link_names, truth.base_name)

    def __len__(self) -> int:
        return len(self._exact)

    def exact(self, k: int) -> TreeData:
        """Trajectory k without noise."""
        record = self._exact.exact(k)
        v, w, a, dw = record.links(self.truth)
        tau = np.hstack([np.zeros((len(record.q), 6)), record.tau])  # nothing pushes a falling base
        base = BodyMotion(record.base_w, record.base_a, record.base_dw, record.base_v)
        joints = record.q, record.dq, record.ddq, tau
        return TreeData(self.tree, *joints, base, BodyMotion(w, a, dw, v))

    def measured(self, k: int) -> TreeData:
        """Trajectory k as its sensors show it, filtered alike."""
        return smoothed_data(self.tree, self.noisy[k])


def gathered(source: Falls, parts: Split, rows: np.ndarray, noisy: bool) -> TreeData:
    """Samples at these rows of the train-and-test part."""
    of = source.measured if noisy else source.exact
    parted = [parts.rows_in(rows, k) for k in range(len(parts.lengths))]
    return stacked([of(k).take(own) for k, own in enumerate(parted) if len(own)])


def sets_of(source: Falls, parts: Split) -> Iterator[tuple[TreeData, dict[str, np.ndarray]]]:
    """Every trajectory without noise, with its rows by set."""
    for k in range(len(source)):
        data = source.exact(k)
        if k in parts.control:
            yield data, {"control": np.arange(len(data))}
        else:
            rows = {"train": parts.rows_in(parts.train, k), "test": parts.rows_in(parts.test, k)}
            yield data, rows


RATE_HZ = 1000.0  # samples a second
# Corner of the low-pass, well above the motion's fastest and well below the noise's, and its order;
# it runs twice.
BANDWIDTH_HZ, ORDER = 20.0, 4
CUT = 200  # samples taken off both ends; the filter's transients fade within 2 / bandwidth


def smoothed_data(
    tree: Tree, measured: Mapping[str, Array], gravity: Array | None = None
) -> TreeData:
    """Samples of one trajectory; a floating base's wrench is zero (free fall).

    Args:
        tree: N and A.
        measured: what the sensors of one trajectory read (m, ...), at a constant rate, without
            holes: q, dq (m, n) rad, rad/s; tau (m, n) joint torques, N m; base_w, base_a (m, 3)
            rad/s, m/s² with gravity, none with a fixed base; link_w, link_a (m, n, 3) of every
            moving link, at its frame, where links have them; base_v, link_v velocities, m/s, where
            something measures them.
        gravity: (3,) in base axes, m/s²; needed with a fixed base, whose motion is that of rest.

    Raises:
        ModelError: signals that are missing, too short, of other lengths, or not finite.
    """
    m, least = len(measured["q"]), 2 * CUT + 30 * ORDER
    if m < least:
        raise ModelError(f"a trajectory needs at least {least} samples, got {m}")
    for name, x in measured.items():
        if len(x) != m or not np.isfinite(x).all():
            raise ModelError(f"{name} must hold {m} samples, all finite")
    sos = butter(ORDER, BANDWIDTH_HZ, fs=RATE_HZ, output="sos")
    smooth = {name: sosfiltfilt(sos, x, axis=0) for name, x in measured.items()}

    def rate(name: str) -> Array:
        return np.asarray(np.gradient(smooth[name], 1.0 / RATE_HZ, axis=0))

    def motion(kind: str) -> BodyMotion | None:
        w, a = (smooth.get(f"{kind}_{s}") for s in "wa")
        if w is None or a is None:
            return None
        return BodyMotion(w, a, rate(f"{kind}_w"), smooth.get(f"{kind}_v"))

    if tree.floating:
        base = motion("base")
    elif gravity is None:
        raise ModelError("a fixed base needs gravity, the direction of which its rest shows")
    else:
        zero = np.zeros((m, 3))
        base = BodyMotion(zero, zero - np.asarray(gravity, dtype=float), zero, zero)
    if base is None:
        raise ModelError("a floating base needs its own base_w and base_a, and one is missing")
    tau = smooth["tau"]
    if tree.floating:
        tau = np.concatenate([np.zeros((m, 6)), tau], axis=1)
    data = TreeData(tree, smooth["q"], smooth["dq"], rate("dq"), tau, base, motion("link"))
    return data.take(slice(CUT, m - CUT))
