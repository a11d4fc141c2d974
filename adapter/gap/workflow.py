"""Where simulation and data disagree, which effect is missing, what the gap is with it.

    recordings, nominal model -> screened -> smooth -> searched -> named -> added -> measured again

Reads nothing but the recordings and the model.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from adapter.gap.evidence import Carried
from adapter.gap.findings import doubted, findings_of, leftovers_of, noise_floor
from adapter.gap.fit import TIMING_STD_S, Fit, refitted, theta_prior
from adapter.gap.inertias import wrong_inertias
from adapter.gap.recorded import Recorded
from adapter.gap.refusals import Refusal, refuse
from adapter.gap.result import Curves, GapResult, RolloutCurves, Shortfall
from adapter.gap.rivals import block_s, fold_of
from adapter.gap.search import Found, search
from adapter.gap.shrink import (
    Simulate,
    held_out_coefficients,
    held_out_models,
    model_of,
    rms,
    rollout_errors,
    torque_errors,
)
from adapter.gap.signals import Signals, prepare
from adapter.gap.timing import Timing
from adapter.model import SelfModel
from adapter.rigid_arm import RigidArm
from adapter.robots import documented
from adapter.torque import active_effects
from drivers.mcap_file import read_log

SIGNIFICANT = 3.0  # standard deviations
TIMING_SHARE = 0.4  # of a sample period: holds of half a sample are no effect of the arm
NO_PRIOR = 1e-4  # times the prior: inertias that must not be corrected
NOT_TOLD = ("motion",)  # refusals that are an answer: the recording holds too little

Progress = Callable[[str], None]


@dataclass(frozen=True)
class GapSettings:
    """How the gap is sought.

    Attributes:
        inertia_prior: by which share the model's inertias may be off, one standard deviation.
        validate_from_s: with one recording: fit before it, score after it; None: by blocks.
    """

    inertia_prior: float = 0.02
    validate_from_s: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.inertia_prior <= 1.0:
            raise ValueError(f"the inertias' prior must be in (0, 1], got {self.inertia_prior}")


@dataclass(frozen=True, eq=False)
class Task:
    """What is there to work with.

    Attributes:
        model: the nominal one.
        fitted, scored: recordings to fit and to score on; the same ones where blocks are held out.
        moving: joints (from 0) that move, per fitted recording.
        period_s: the longest sample period.
        one_clock: what is scored belongs to the recording that is fitted.
        notes: what is known of the logs.
    """

    model: SelfModel
    fitted: tuple[Recorded, ...]
    scored: tuple[Recorded, ...]
    moving: tuple[tuple[int, ...], ...]
    period_s: float
    one_clock: bool
    notes: tuple[str, ...]

    @property
    def folds(self) -> bool:
        """The fit's own recordings are scored, each block by a fit without it."""
        return self.fitted == self.scored


def analyse(
    logs: Sequence[Path | str],
    model: Path | str | SelfModel,
    settings: GapSettings | None = None,
    simulate: Simulate | None = None,
    model_out: Path | None = None,
    progress: Progress = lambda text: None,
) -> GapResult:
    """Find what the model lacks.

    Args:
        logs: MCAP recordings; of several the last one is held out.
        model: self model, or a file of one, or a URDF, or a known robot's name.
        settings: see there.
        simulate: forward simulation; without it only torques are compared.
        model_out: where the new model goes.
        progress: hears what is being done.

    Raises:
        Refusal: another robot; units, sign or order of the signals are not the model's.
        DriverError, ModelError: unreadable files.
    """
    begun = time.monotonic()
    settings = settings or GapSettings()
    name = model.name if isinstance(model, SelfModel) else str(model)
    # dates of an earlier recording mean nothing in this one
    nominal = lasting(model if isinstance(model, SelfModel) else documented(str(model)))
    try:
        task = _task([Path(log) for log in logs], nominal, settings, progress)
    except Refusal as refusal:
        if refusal.kind not in NOT_TOLD:
            raise
        names = [Path(log).name for log in logs]
        joints = nominal.tree.joint_names
        return GapResult.untold(joints, nominal.name, names, name, str(refusal))
    progress("smoothing")
    found = _corrected_where_it_pays(task, _searched(task, settings, progress))
    result = _measured(task, found, simulate, progress)
    if model_out is not None:
        model_of(nominal, found.fit).save(model_out)
        result = replace(result, model_out=str(model_out))
    return replace(result, model_in=name, wall_s=time.monotonic() - begun)


def _task(
    logs: Sequence[Path], model: SelfModel, settings: GapSettings, progress: Progress
) -> Task:
    """Read and screen. Raises Refusal."""
    arm = RigidArm.of(model)
    recordings, moving, periods, notes = [], [], [], []
    for path in logs:
        progress(f"reading {path.name}")
        screened = refuse(read_log(path), model, arm)
        recordings.append(Recorded.of(screened.log, _lateness(screened.timing)))
        moving.append(screened.moving)
        periods.append(screened.timing.period_s)
        prefix = f"{path.name}: " if len(logs) > 1 else ""
        notes += [prefix + sentence for sentence in screened.notes]
    if len(recordings) > 1:
        fitted, scored = tuple(recordings[:-1]), tuple(recordings[-1:])
    elif settings.validate_from_s is not None:
        fitted, scored = _split(recordings[0], settings.validate_from_s)
    else:
        fitted = scored = tuple(recordings)
    stay = moving[: len(fitted)]
    return Task(model, fitted, scored, tuple(stay), max(periods), len(logs) == 1, tuple(notes))


def _lateness(timing: Timing) -> float:
    """How much later dq is than q, where that is known, s."""
    late, std = timing.lateness_s, timing.lateness_std_s
    return late if np.isfinite(late) and abs(late) > SIGNIFICANT * std else 0.0


def lasting(model: SelfModel) -> SelfModel:
    """The model in another recording: its effects that had not ended, at all times."""
    kept = []
    for entry in model.effects:
        begin, end = entry.get("interval_s") or (None, None)
        if end is None:
            kept.append(dict(entry, interval_s=None) if begin is not None else entry)
    return replace(model, effects=tuple(kept))


def _split(whole: Recorded, at_s: float) -> tuple[tuple[Recorded], tuple[Recorded]]:
    if not whole.t[0] + 3.0 < at_s < whole.t[-1] - 2.0:
        raise ValueError(
            f"validation from {at_s} s needs 3 s before and 2 s after it; "
            f"{whole.name} has {whole.t[-1]:.1f} s"
        )
    cut = int(np.searchsorted(whole.t, at_s))
    return (whole.part(slice(cut)),), (whole.part(slice(cut, None)),)


def _searched(task: Task, settings: GapSettings, progress: Progress) -> Found:
    arm = RigidArm.of(task.model)
    known = active_effects(task.model.effects, arm.n)
    anywhere = sorted({j for joints in task.moving for j in joints})
    everything = tuple(dict.fromkeys((*task.fitted, *task.scored)))
    signals = tuple(prepare(r, arm, r.repeated_in(everything)) for r in task.fitted)
    prior = theta_prior(arm.theta, settings.inertia_prior)
    zero = np.zeros_like(arm.theta)
    still = tuple(tuple(j for j in range(arm.n) if j not in m) for m in task.moving)
    timing = max(TIMING_STD_S, TIMING_SHARE * task.period_s)
    fit = Fit(signals, prior, (), zero, known=known, still=still, timing_std_s=timing)
    fit = fit.with_noise()
    progress("searching")
    found = search(fit, anywhere, progress)
    return wrong_inertias(fit, found, anywhere) or found


def _corrected_where_it_pays(task: Task, found: Found) -> Found:
    """Without the corrections of the inertias where they do not pay on held-out data."""
    fit, carried = refitted(replace(found.fit, prior=NO_PRIOR * found.fit.prior))
    costs = []
    for own, known in ((found.fit, found.carried), (fit, carried)):
        folds = held_out_models(task.model, own, known)
        errors = [torque_errors(r, task.model, folds, block_s(own)) for r in task.fitted]
        level = noise_floor(found.fit)
        costs.append(np.sum((rms([e.after for e in errors]) / level) ** 2))
    if costs[0] <= costs[1]:
        return found
    kept = replace(fit, dtheta=np.zeros_like(fit.dtheta), prior=found.fit.prior)
    return replace(found, fit=kept, carried=carried, known=kept.carried())


def _after(task: Task, fit: Fit, carried: Carried) -> list[SelfModel]:
    """The models to score: one per fold, or one where the data are apart from the fit's."""
    if task.folds:
        return held_out_models(task.model, fit, carried)
    model = model_of(task.model, fit)
    return [model if task.one_clock else lasting(model)]


def _measured(task: Task, found: Found, simulate: Simulate | None, progress: Progress) -> GapResult:
    """Before and after on held-out data, and all that was found."""
    after = _after(task, found.fit, found.carried)
    errors = [torque_errors(r, task.model, after, block_s(found.fit)) for r in task.scored]
    before = Shortfall(rms([e.before for e in errors]))
    behind = Shortfall(rms([e.after for e in errors]))
    rollouts: tuple[RolloutCurves, ...] = ()
    if simulate is not None:
        progress("simulating forward")
        runs = [
            rollout_errors(r, task.model, after, simulate, block_s(found.fit)) for r in task.scored
        ]
        before = replace(
            before,
            rollout_rmse_rad=rms([x.before_q for x in runs]),
            rollout_rmse_rad_s=rms([x.before_dq for x in runs]),
        )
        behind = replace(
            behind,
            rollout_rmse_rad=rms([x.after_q for x in runs]),
            rollout_rmse_rad_s=rms([x.after_dq for x in runs]),
        )
        rollouts = tuple(x.curves for x in runs)
    ends = [float(r.t[-1]) for r in task.fitted]
    unexplained = leftovers_of(found, ends)
    findings = doubted(findings_of(found, ends), unexplained)
    return GapResult(
        joint_names=task.model.tree.joint_names,
        model_name=task.model.name,
        recordings=tuple(dict.fromkeys(r.name for r in (*task.fitted, *task.scored))),
        model_in="",
        noise_floor_nm=noise_floor(found.fit),
        before=before,
        after=behind,
        findings=findings,
        unexplained=unexplained,
        corrections=found.fit.dtheta,
        corrections_prior=found.fit.prior,
        notes=task.notes,
        curves=tuple(_curves(task, found, i) for i in range(len(task.fitted))),
        rollouts=rollouts,
        what_next=tuple(dict.fromkeys(f.split_by for f in findings if f.overlaps)),
    )


def _curves(task: Task, found: Found, i: int) -> Curves:
    own: Signals = found.fit.recordings[i]
    nominal = Fit(
        (own,), found.fit.prior, (), np.zeros_like(found.fit.dtheta), known=found.fit.known
    )
    after = np.empty_like(own.tau)
    for f, x in enumerate(held_out_coefficients(found.fit, found.carried)):
        rows = fold_of(own.t, block_s(found.fit)) == f
        after[rows] = found.fit.at(x).without_patterns().residual(i)[rows]
    rows = np.searchsorted(own.motion.t, own.t - 1e-9)
    motion = own.motion
    return Curves(
        task.fitted[i].name,
        own.t,
        motion.q[rows],
        motion.dq[rows],
        motion.ddq[rows],
        own.tau,
        nominal.residual(0),
        after,
        np.zeros(len(own.t), dtype=bool),
    )
