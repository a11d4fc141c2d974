"""Gains of drives: how many N m at a joint's link one recorded unit of its effort stands for.

    effort_j = (Y_j θ + friction_j) / gain_j + noise

Noise is on the side of the effort, so the model's torque is divided and the effort is not
multiplied: least squares then have no bias towards small gains. Gains, inertias, friction,
motor inertia and offsets are fitted together by the search's own least squares. All gains, masses
and frictions times one factor explain the same efforts: the documented masses, as far as these may
be off, or one body of known mass at the hand fix that factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from adapter.effects.base import Template
from adapter.effects.catalogue import CATALOGUE
from adapter.errors import SettingsError
from adapter.gap.candidates import Candidate
from adapter.gap.evidence import Carried
from adapter.gap.fit import Fit, Named, honest_covariance, place_of
from adapter.gap.real_arm import as_driven, fitting_way, load_in, nominal_fit
from adapter.gap.signals import RATE_HZ, Recorded, prepare
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.readings import torque_shares
from adapter.screening.screen import cleaned, judged_rows, moving_joints, smoothed_rows
from adapter.screening.timing import lateness
from adapter.signals.matching import present
from adapter.signals.told import Told
from drivers.files.mcap import Log, read_log

DOCUMENTED_STD, WEIGHED_STD = 0.1, 0.2  # of the inertias: alone, and beside a known mass
KNOWN_SHARE = 1e-3  # to which a known mass is weighed
ROUNDS, NOISE_ROUNDS, STEPS = 3, 3, 4  # of the whole; of noise after fit; of each fit
LEARNED_SHARE = 2.0 / 3.0  # of every recording, for the check on the rest
SLIDES_RAD_S, AROUND_S = 0.1, 0.1  # slower, so long before or after, a joint sticks
GAIN = CATALOGUE["torque_gain"]


def as_told(
    logs: Sequence[Log], model: SelfModel, told: Told, learned_from: Sequence[Log] = ()
) -> tuple[list[Log], TorqueGains | None]:
    """Recordings as the model means them, as somebody said they are to be understood.

    Args:
        logs: as read; model: of the arm; told: of them all.
        learned_from: which gains are learned from, where not from all; those that carry the
            known load are read beside them.

    Returns:
        The recordings, as they were where nobody said anything, and what was learned.

    Raises:
        SettingsError: see `Told.log`; no known load in the recordings.
        Refusal: what gains cannot be learned from.
    """
    for log in logs:
        model, _ = present(model, log.joint_names, log.path)
    if not told.learn:
        return [told.log(log, model) for log in logs], None
    taught = list(learned_from or logs)
    held = [path.resolve() for path in told.loaded]
    taught += [read_log(path) for path in told.loaded if path.resolve() not in _paths(taught)]
    loaded = [told.load_kg is not None and (not held or p in held) for p in _paths(taught)]
    taught = [told.log(log, model) for log in taught]
    gains = learn_gains(taught, model, loaded, told.load_kg)
    return [told.log(log, model, gains.gain) for log in logs], gains


def _paths(logs: Sequence[Log]) -> list[Path]:
    return [log.path.resolve() for log in logs]


@dataclass(frozen=True, eq=False)
class TorqueGains:
    """Gains that were learned.

    Attributes:
        joint_names: of the model; gain, std: (n,) N m per recorded unit.
        shown: (n,) whether the recordings show a gain; another is the middle one of the shown.
        load_kg: known mass; None where the documented masses alone say how large gains are.
        held_out_nm: (n,) rms of efforts in N m less the model that two thirds of each recording
            gave, over its last third; size_nm: of the efforts there.
        moved: share by which gains differ between two thirds and all, the largest shown.
        notes: on the recordings.
    """

    joint_names: tuple[str, ...]
    gain: Array
    std: Array
    shown: NDArray[np.bool_]
    load_kg: float | None
    held_out_nm: Array
    size_nm: Array
    moved: float
    notes: tuple[str, ...] = field(default=())

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "gain_nm_per_unit": self.gain.tolist(),
            "std": [float(s) if ok else None for s, ok in zip(self.std, self.shown, strict=True)],
            "shown": self.shown.tolist(),
            "known_load_kg": self.load_kg,
            "scale_open": self.load_kg is None,
            "held_out_nm": self.held_out_nm.tolist(),
            "held_out_torque_nm": self.size_nm.tolist(),
            "moved_share": self.moved,
        }

    def words(self) -> list[str]:
        """What was learned, how sure it is, and what stays open."""
        told = ", ".join(
            f"{name} {g:.3g} ± {s:.1g}" if ok else f"{name} {g:.3g} (not shown)"
            for name, g, s, ok in zip(
                self.joint_names, self.gain, self.std, self.shown, strict=True
            )
        )
        off = ", ".join(f"{x:.2g}" for x in self.held_out_nm)
        size = ", ".join(f"{x:.2g}" for x in self.size_nm)
        scale = (
            "gains and masses cannot be told apart without one known mass: all gains, masses and "
            "frictions times one factor explain the same efforts, and the scale of all of them is "
            "open beyond what the documented masses say; --known-load KG fixes it"
        )
        if self.load_kg is not None:
            scale = f"their scale is that of the known load, {self.load_kg:g} kg"
        return [
            f"gains learned, N m per recorded unit: {told}; {scale}",
            f"gains from the first two thirds: off by {off} N m (of {size}) on the last third; "
            f"they differ from those of all data by {100.0 * self.moved:.2g} % at most",
        ]


def learn_gains(
    logs: Sequence[Log], model: SelfModel, loaded: Sequence[bool] = (), load_kg: float | None = None
) -> TorqueGains:
    """Gains of the drives of one arm.

    Args:
        logs: in recorded units, motors' gears applied; model: of the arm, tool included.
        loaded: of each recording whether the hand carries the known load, from the first sample
            to the last; load_kg: its mass.

    Raises:
        Refusal: another robot, too few samples, too little motion, units of q and dq.
    """
    notes: list[str] = []
    for log in logs:
        model, said = present(model, log.joint_names, log.path.name)
        notes += said
    usable = [cleaned(log, model) for log in logs]
    recordings = [Recorded.of(log, lateness(clock)).cut() for log, clock, _ in usable]
    shares = [torque_shares(*judged_rows(x, model, smoothed_rows(x))) for x, *_ in usable]
    if not any(x.tells.any() for x in shares):
        raise SettingsError(
            f"{logs[0].path}: no joint's effort follows the model's torque: no gain can be learned"
        )
    task = _GainTask(
        model,
        tuple(recordings),
        tuple(loaded) or (False,) * len(logs),
        load_kg,
        max(clock.period_s for _, clock, _ in usable),
        np.any([x.tells for x in shares], axis=0),
    )
    # of each joint from the recording that tells most of it; else the middle of the told
    doubt = np.array([np.where(x.tells, x.std / np.abs(x.share), np.inf) for x in shares])
    best = np.argmin(doubt, axis=0)
    own = np.array([1.0 / abs(shares[k].factor[j]) for j, k in enumerate(best)])
    told = np.isfinite(doubt).any(axis=0)
    start = np.where(told, own, np.median(own[told]))
    begun = [r.between(0.0, float(r.t[int(LEARNED_SHARE * len(r.t))])) for r in recordings]
    first, fit, _ = _fitted(replace(task, recordings=tuple(begun)), start)
    held_out, size = _on_the_rest(task, fit, first)
    gain, fit, std = _fitted(task, first)
    shown = std < 0.25 * np.abs(gain)  # one standard deviation, above which a gain is not shown
    if shown.any():
        gain = np.where(shown, gain, np.median(gain[shown]))
    moved = float(np.abs(first / gain - 1.0)[shown].max(initial=0.0))
    names, load = model.tree.joint_names, load_kg if any(task.loaded) else None
    return TorqueGains(
        names, gain, std, shown, load, held_out, size, moved, tuple(dict.fromkeys(notes))
    )


@dataclass(frozen=True, eq=False)
class _GainTask:
    """Recordings, those that hold the known load, and joints that tell their gain alone."""

    model: SelfModel
    recordings: tuple[Recorded, ...]
    loaded: tuple[bool, ...]
    load_kg: float | None
    period_s: float
    tells: NDArray[np.bool_]


def _fitted(task: _GainTask, gain: Array) -> tuple[Array, Fit, Array]:
    """Gains (n,), the fit in N m under them, and their standard deviations (n,)."""
    n, known = len(gain), task.load_kg if any(task.loaded) else None
    std, own = (DOCUMENTED_STD if known is None else WEIGHED_STD), GAIN.templates()[0]
    wide = Template((0.5,), own.decode, own.label)  # of what one joint's regression says
    # of joints whose torque tells one; of all where a known load makes torque in every joint
    joints = range(n) if known is not None else np.flatnonzero(task.tells).tolist()
    gains = [Named(Candidate(GAIN, wide, int(j), ()), np.zeros(1)) for j in joints]
    for _ in range(ROUNDS):
        scaled = [replace(r, tau=r.tau * gain) for r in task.recordings]
        start = nominal_fit(scaled, task.model, std, task.period_s)
        moving = sorted(
            {j for s in start.recordings for j in moving_joints(s.motion.q, s.motion.dq)}
        )
        fit = as_driven(start, moving, [*_loads(start, task), *gains])
        fit = fit.with_named([_open(fit, e) if e.assumed else e for e in fit.named])
        for _ in range(NOISE_ROUNDS):
            fit, carried = _settled(_sliding(fit.with_noise()), known)
        at, off = _gain_places(fit)
        step = np.zeros(n)
        step[at] = fit.coefficients[off]
        gain = gain / (1.0 + step)
        if np.abs(step).max() < 2e-3:  # share of a gain that ends the rounds
            break
    doubt = np.full(n, np.inf)
    covariance = honest_covariance(fit, carried)
    doubt[at] = np.sqrt(np.diagonal(covariance)[off]) * np.abs(gain[at])
    return gain, fit, doubt


def _loads(fit: Fit, task: _GainTask) -> list[Named]:
    if task.load_kg is None or not any(task.loaded):
        return []
    own = [None] if all(task.loaded) else [i for i, held in enumerate(task.loaded) if held]
    loads = [load_in(fit, i) for i in own]
    held = np.zeros(len(loads[0].x))
    held[0] = task.load_kg
    return [fitting_way(fit, e.at(held)) for e in loads]


def _open(fit: Fit, e: Named) -> Named:
    """What any arm has, of any size: in another unit a Panda's friction says nothing.

    One standard deviation makes as much torque as the joint's whole effort has.
    """
    j = e.candidate.joint
    effort = np.concatenate([own.tau[:, j] for own in fit.recordings])
    at = place_of(fit, fit.named.index(e))
    both = [fit.model.signatures(i)[at, :, j] for i in range(len(fit.recordings))]
    slopes = np.concatenate(both, axis=1)
    size = np.sqrt(np.mean(effort**2)) / np.sqrt(np.mean(slopes**2, axis=1))
    template = replace(e.candidate.template, prior_std=tuple(map(float, size)))
    return replace(e, candidate=replace(e.candidate, template=template))


def _sliding(fit: Fit) -> Fit:
    """The fit without rows in which a joint rests or turns round: no law of friction holds there.

    What it gets wrong then goes with the acceleration, and would make gains 2 % too small.
    """
    doubts = []
    for own, doubt in zip(fit.recordings, fit.doubts, strict=True):
        slow = np.abs(own.motion.dq) < SLIDES_RAD_S
        near = maximum_filter1d(slow, 2 * round(AROUND_S * RATE_HZ) + 1, axis=0)
        at = np.searchsorted(own.motion.t, own.t)
        doubts.append(np.where(near[np.minimum(at, len(near) - 1)], np.inf, doubt))
    return replace(fit, doubts=tuple(doubts))


def _settled(fit: Fit, known_kg: float | None) -> tuple[Fit, Carried]:
    """The fit at its most probable coefficients, with loads of known mass."""
    weighed = [
        int(place_of(fit, k)[0])
        for k, e in enumerate(fit.named)
        if known_kg is not None and e.candidate.columns_are_theta
    ]
    for _ in range(STEPS):
        carried = fit.carried()
        if known_kg is not None and weighed:
            rows = np.zeros((len(fit.coefficients), len(weighed)))
            rows[weighed, range(len(weighed))] = 1.0 / (KNOWN_SHARE * known_kg)
            data = np.append(carried.data, np.full(len(weighed), 1.0 / KNOWN_SHARE))
            carried = Carried(np.hstack([carried.N, rows]), carried.prior_std, data)
        fit = fit.at(carried.x)
    return fit, carried


def _gain_places(fit: Fit) -> tuple[list[int], list[int]]:
    """Joints (from 0) that have a gain, and where it is among the coefficients."""
    own = [(k, e) for k, e in enumerate(fit.named) if e.candidate.effect is GAIN]
    return [e.candidate.joint for _, e in own], [int(place_of(fit, k)[0]) for k, _ in own]


def _on_the_rest(task: _GainTask, fit: Fit, gain: Array) -> tuple[Array, Array]:
    """(n,) N m rms error of a fit behind the data that it saw, and the size of the torque there.

    Where joints stick counts here, so it is fitted, too.
    """
    arm = RigidArm.of(task.model)
    ends = (float(r.t[int(LEARNED_SHARE * len(r.t))]) for r in task.recordings)
    parts = (r.between(end_s, np.inf) for r, end_s in zip(task.recordings, ends, strict=True))
    rest = [prepare(replace(part, tau=part.tau * gain), arm) for part in parts]
    fit, _ = _settled(replace(fit, doubts=()), task.load_kg if any(task.loaded) else None)
    step = np.ones(len(gain))
    at, off = _gain_places(fit)
    step[at] = 1.0 + fit.coefficients[off]
    model = replace(fit.model, recordings=tuple(rest))
    errors = [own.tau - model.predicted(i) / step for i, own in enumerate(rest)]
    return _rms(errors), _rms([own.tau for own in rest])


def _rms(tables: Sequence[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.concatenate(tables) ** 2, axis=0)))
