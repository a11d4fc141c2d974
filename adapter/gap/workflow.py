"""Where simulation and data disagree, which effect is missing, what the gap is with it.

A log passes through each station once, left to right:

    screen -> signals -> search (candidates, evidence) -> held out -> findings -> words

Reads nothing but the recordings and the model, no clock but for the time taken, and writes
nothing but the new model where it is told where.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from adapter.effects.catalogue import CATALOGUE, HELD, KNOWN
from adapter.effects.robots import read_robot
from adapter.gap.candidates import Candidate
from adapter.gap.changes import loaded, with_changes
from adapter.gap.evidence import Carried
from adapter.gap.findings import ODD, disagreement, findings_of, noise_floor, told_of
from adapter.gap.fit import Fit, place_of, worth
from adapter.gap.folds import holds_out
from adapter.gap.hand import hand_frame
from adapter.gap.held_out import GapTask, HeldOut, Simulate, lasting, measure, model_of
from adapter.gap.laws import notes_on
from adapter.gap.load import plain_load
from adapter.gap.long_recording import (
    LongRecording,
    Survey,
    is_long,
    part_of,
    sampling,
    sampling_words,
)
from adapter.gap.real_arm import SURE, nominal_fit, real_arm
from adapter.gap.result import GapResult, Unseen
from adapter.gap.rivals import Standing
from adapter.gap.scan import BELIEF, SignatureTable, least_chi2
from adapter.gap.search import ROUNDS, Found, search
from adapter.gap.several import Several
from adapter.gap.signals import LEAST_S, RATE_HZ, Recorded
from adapter.gap.torque_gains import TorqueGains, as_told
from adapter.judgement.priors import DOCUMENTED_SHARE, documented_std
from adapter.model.model_file import save_model
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import (
    RecordingFault,
    RecordingRefused,
    Screened,
    cleaned,
    moving_joints,
    of_this_robot,
    refuse,
    standing,
)
from adapter.screening.timing import lateness
from adapter.signals.importer import read_log
from adapter.signals.matching import present
from adapter.signals.told import AS_RECORDED, Told
from drivers.files.mcap import Log

SEARCHED_S = 20.0  # of several recordings
NO_NAME = 0.5  # probability below which an effect is not told by name
FIT_S, SCORE_S = 3.0, 2.0  # the least of a recording that is fitted; and scored

Progress = Callable[[str], None]


@dataclass(frozen=True)
class GapSettings:
    """How the gap is sought.

    Attributes:
        inertia_prior: by which share the model's inertias may be off, one standard deviation.
        validate_from_s: with one recording: fit before it, score after it; None: by blocks.
        hold_out: recordings to score on, among those that are given or not. All others are
            fitted; where none is held out, blocks of time of all are in turn.
        told: how the recordings tell joints and efforts, where it is not as the model has them.
        rounds: of the search, each of which may name something; where they do not suffice the
            result says so. Counted, not timed: the same log gives the same result anywhere.
    """

    inertia_prior: float = DOCUMENTED_SHARE
    validate_from_s: float | None = None
    hold_out: tuple[Path | str | Log, ...] = ()
    rounds: int = ROUNDS
    told: Told = AS_RECORDED

    def __post_init__(self) -> None:
        if not 0.0 < self.inertia_prior <= 1.0:
            raise ValueError(f"the inertias' prior must be in (0, 1], got {self.inertia_prior}")
        if self.rounds < 1:
            raise ValueError(f"the search needs at least one round, got {self.rounds}")
        if self.hold_out and self.validate_from_s is not None:
            raise ValueError("score from a second on, or on recordings held out: not both")


def find_gap(
    logs: Sequence[Path | str | Log],
    model: Path | str | SelfModel,
    settings: GapSettings | None = None,
    simulate: Simulate | None = None,
    model_out: Path | None = None,
    progress: Progress = lambda text: None,
) -> GapResult:
    """Find what the model lacks.

    Args:
        logs: MCAP recordings of one arm, or read ones.
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
    nominal = lasting(model if isinstance(model, SelfModel) else read_robot(str(model)))
    try:
        task, gains, screened = _task(logs, nominal, settings, progress)
    except RecordingRefused as refusal:
        if not refusal.kind.is_an_answer:
            raise
        names = names_of([*logs, *settings.hold_out])
        untold = GapResult.untold(nominal.tree.joint_names, nominal.name, names, name, str(refusal))
        if refusal.kind is not RecordingFault.MOTION or len(logs) > 1:
            return untold
        return _with_what_is_held(untold, logs[0], nominal, settings)
    progress("smoothing")
    prior = settings.inertia_prior
    fit = nominal_fit(task.fitted, task.model, prior, task.period_s, task.scored)
    several = None
    if len(task.fitted) > 1:
        progress("weighing what each recording carries")
        several = Several.of(fit, [r.name for r in task.fitted], hand_frame(nominal))
        task, fit = _searched(task, several.started(fit), [x.recording for x in several.odd])
    elif task.fitted[0].loads_s:
        progress("weighing what the hand picked up or put down")
        fit = loaded(fit, task.moving[0], task.fitted[0].loads_s)
    progress("searching")
    moving = sorted({j for joints in task.moving for j in joints} & fit.heard)
    found = search(fit, moving, settings.rounds, progress)
    hidden = unseen(found, moving)
    measured = measure(task, found, simulate, progress)
    result = replace(_result(task, measured, settings), model_in=name, unseen=hidden)
    if several is not None:
        result = several.told(result)
    elif not is_long(screened[0].log):
        result = beside_plain(result, screened[0], task.model, prior)
    if gains is not None:
        notes = (*gains.words(), *gains.notes, *result.notes)
        result = replace(result, torque_gains=gains.as_dict(), notes=notes)
    if model_out is not None:
        found = measured.found
        known = found.known or found.carried
        save_model(model_of(task.model, found.fit, known=known), model_out)
        result = replace(result, model_out=str(model_out))
    return replace(result, wall_s=time.monotonic() - begun)


def _with_what_is_held(
    untold: GapResult, log: Path | str | Log, model: SelfModel, settings: GapSettings
) -> GapResult:
    """A load at the hand, where it is more than static friction and offsets can hold at rest."""
    whole = log if isinstance(log, Log) else read_log(Path(log))
    part = part_of(whole, present(model, whole.joint_names, whole.path.name)[0])
    part = settings.told.log(part, model)
    model, _ = present(model, part.joint_names, part.path.name)
    clean, clock, _ = cleaned(part, model)
    own = Recorded.of(clean, lateness(clock))
    if own.t[-1] - own.t[0] < LEAST_S:
        return untold
    nominal = nominal_fit([own], model, settings.inertia_prior, clock.period_s)
    arm = real_arm(nominal, (), (0,))
    if not arm.is_there(0):
        return untold
    values = [worth(arm.fit, arm.known, k) for k in range(len(arm.fit.named))]
    standings = tuple(
        Standing(e.candidate, value.log_evidence, value.chi2, ())
        for e, value in zip(arm.fit.named, values, strict=True)
    )
    others = frozenset(range(1, len(standings)))
    (load,) = findings_of(Found(arm.fit, arm.known, standings, weak=others), {own.name: own.t[-1]})
    said = f"{untold.problem} The hand holds {load.parameters['m']:.2g} ± {load.std['m']:.2g} kg."
    return replace(untold, problem=said, findings=(load,))


def _task(
    logs: Sequence[Path | str | Log], model: SelfModel, settings: GapSettings, progress: Progress
) -> tuple[GapTask, TorqueGains | None, list[Screened]]:
    """Read, convert and screen. Raises Refusal."""
    held = settings.hold_out
    kept = [log for log in logs if not any(_same(log, other) for other in held)]
    if not kept:
        raise ValueError("nothing is left to fit: every recording is held out")
    if settings.validate_from_s is not None and len(kept) > 1:
        raise ValueError("validate_from_s splits one recording; of several, hold one out")
    read, locked, names = [], [], names_of([*kept, *held])
    for log, name in zip([*kept, *held], names, strict=True):
        progress(f"reading {name}")
        read.append(log if isinstance(log, Log) else read_log(Path(log)))
        model, said = present(model, read[-1].joint_names, name)
        locked += [*read[-1].warnings, *said]
    if settings.told.learn:
        progress("learning the gains of the drives")
        taught = [part_of(log, model, settings.validate_from_s) for log in read[: len(kept)]]
    else:
        taught = []
    read, gains = as_told(read, model, settings.told, taught)
    taken = []
    for log, name in zip(read, names, strict=True):
        if is_long(log):
            progress(f"reading {name} in pieces")
        taken.append(_taken(log, name, model))
    if len(kept) == 1:
        taken[0] = _divided(taken[0], model, settings, progress)
    fitted = tuple(x.fitted for x in taken[: len(kept)])
    scored = tuple(x.fitted for x in taken[len(kept) :]) if held else fitted
    if taken[0].scored is not None:
        scored = (taken[0].scored,)
    screened = [x.screened for x in taken]
    said_of = zip(names, (x.notes for x in screened), strict=True)
    notes = (f"{name}: {x}" if len(names) > 1 else x for name, own in said_of for x in own)
    task = GapTask(
        model,
        fitted,
        scored,
        moving=tuple(x.moving for x in screened[: len(fitted)]),
        period_s=max(x.timing.period_s for x in screened),
        one_clock=not held,
        notes=(*dict.fromkeys(locked), *notes, *sampling_words(fitted)),
    )
    return task, gains, screened


class _Taken(NamedTuple):
    """A recording, screened, and what of it is fitted; what is scored where that is another."""

    screened: Screened
    fitted: Recorded
    scored: Recorded | None = None


def _taken(log: Log, name: str, model: SelfModel) -> _Taken:
    """Raises RecordingRefused."""
    if is_long(log):
        survey = Survey.of(of_this_robot(log, model))
        seen = refuse(survey.busiest(log), model)
        if seen.torque.late_s:
            survey = Survey.of(seen.torque.in_time(survey.log))
        long = LongRecording.through(survey, name)
        motion = long.signals(RigidArm.of(model)).motion
        moving = moving_joints(motion.q, motion.dq, 1.0 / RATE_HZ) or seen.moving
        said = standing(model.tree.joint_names, moving, motion.q, motion.dq)
        return _Taken(replace(seen, timing=survey.clock, moving=moving, standing=said), long)
    seen = refuse(log, model)
    own = seen.torque.in_time(seen.log)
    fitted = replace(Recorded.of(own, lateness(seen.timing)).cut(), name=name)
    return _Taken(seen, fitted)


def _divided(taken: _Taken, model: SelfModel, settings: GapSettings, progress: Progress) -> _Taken:
    """The only recording, with what is fitted and what is scored of it."""
    at_s, whole = settings.validate_from_s, taken.fitted
    if at_s is not None:
        if not whole.t[0] + FIT_S < at_s < whole.end_s - SCORE_S:
            raise ValueError(
                f"validation from {at_s} s needs {FIT_S:g} s before and {SCORE_S:g} s after it; "
                f"{whole.name} has {whole.end_s:.1f} s"
            )
        taken = taken._replace(scored=whole.between(at_s, np.inf))
        whole = whole.between(0.0, at_s)
    if isinstance(whole, LongRecording):
        progress("looking for changes in all of it")
        whole = with_changes(whole, model, settings.inertia_prior)
    return taken._replace(fitted=whole)


def names_of(logs: Sequence[Path | str | Log]) -> list[str]:
    """What recordings are called: their files' names, with folders where two have the same."""
    paths = [log.path if isinstance(log, Log) else Path(log) for log in logs]
    names = [path.name for path in paths]
    for k in range(2, max((len(path.parts) for path in paths), default=0) + 1):
        count, pairs = Counter(names), zip(names, paths, strict=True)
        names = [str(Path(*p.parts[-k:])) if count[x] > 1 else x for x, p in pairs]
    again = [names[:k].count(name) for k, name in enumerate(names)]
    return [f"{name} ({k + 1})" if k else name for name, k in zip(names, again, strict=True)]


def _same(one: Path | str | Log, other: Path | str | Log) -> bool:
    """Whether two stand for one recording."""
    if isinstance(one, Log) or isinstance(other, Log):
        return one is other
    return Path(one).resolve() == Path(other).resolve()


def _searched(task: GapTask, fit: Fit, odd: Sequence[int]) -> tuple[GapTask, Fit]:
    """The recordings that are searched: those in which most moves, for some time together.

    What is common shows in those, and their own; a search through all would take long.

    Args:
        fit: on all of them; odd: places of recordings that are not of the arm of the others.
    """
    moved = [float(np.abs(r.motion.dq).sum()) for r in fit.recordings]
    order = [int(i) for i in np.argsort(moved)[::-1] if i not in odd]
    lengths = np.cumsum([task.fitted[i].seconds for i in order])
    chosen = sorted(order[: max(int(np.searchsorted(lengths, SEARCHED_S)) + 1, 2)])
    if len(chosen) == len(task.fitted):
        return task, fit
    named = [
        e if e.recording is None else replace(e, recording=chosen.index(e.recording))
        for e in fit.named
        if e.recording is None or e.recording in chosen
    ]
    recordings = tuple(fit.recordings[i] for i in chosen)
    model = replace(fit.model, recordings=recordings, named=tuple(named))
    fitted = tuple(task.fitted[i] for i in chosen)
    names = ", ".join(r.name for r in fitted)
    note = f"searched, and scored by blocks: {names}, in which most moves; the others are weighed"
    task = replace(
        task,
        fitted=fitted,
        scored=fitted if task.folds else task.scored,
        moving=tuple(task.moving[i] for i in chosen),
        notes=(*task.notes, note),
    )
    return task, replace(fit, model=model, noise=(), doubts=()).with_noise()


def _result(task: GapTask, measured: HeldOut, settings: GapSettings) -> GapResult:
    """All that was found and measured."""
    found, floor = measured.found, noise_floor(measured.found.fit)
    ends = {r.name: r.end_s for r in task.fitted}
    trusted = documented_std(RigidArm.of(task.model).theta, settings.inertia_prior)
    told, left = told_of(found, ends, trusted)
    findings = tuple(f for f in told if f.evidence >= NO_NAME)
    notes = [unnamed(f.title, f.joints) for f in told if f.evidence < NO_NAME]
    notes += notes_on(found.fit)
    placed = any(KNOWN[f.effect].is_theta for f in findings)
    if np.abs(found.fit.dtheta / trusted).max() > ODD and not placed:
        notes.append(
            "the inertias were corrected by more than 4 prior standard deviations; which link it "
            "is, these data do not tell"
        )
    if found.weak:
        notes.append(
            "the model has what any arm has (friction, motor inertia, offsets) where these data do "
            "not single it out, too: it is not told by name"
        )
    splits = (x for f in findings if f.split_by for x in f.split_by.split("; "))
    return GapResult(
        joint_names=task.model.tree.joint_names,
        model_name=task.model.name,
        recordings=tuple(dict.fromkeys(r.name for r in (*task.fitted, *task.scored))),
        model_in="",
        noise_floor_nm=floor,
        before=measured.before,
        after=measured.after,
        findings=findings,
        unexplained=left,
        where=disagreement(measured.curves[0], floor),
        corrections=found.fit.dtheta,
        corrections_prior=found.fit.prior,
        stopped_after_rounds=found.rounds if found.ran_out else None,
        notes=(*task.notes, *notes),
        curves=measured.curves,
        rollouts=measured.rollouts,
        what_next=tuple(dict.fromkeys(splits)),
        sampled=sampling(task.fitted),
        in_sample=task.folds and not holds_out(found.fit),
        slides=task.model.tree.slides if any(task.model.tree.slides) else (),
    )


def beside_plain(
    result: GapResult, screened: Screened, model: SelfModel, prior: float
) -> GapResult:
    """A result with the load of plain least squares, where the search's is clearly another."""
    held = [f for f in result.findings if f.effect == HELD.name and f.throughout]
    if not held:
        return result
    plain = plain_load(screened.torque.in_time(screened.log), model, prior)
    mass, std = held[0].parameters["m"], held[0].std["m"]
    if abs(mass - plain.mass) < std + plain.mass_std:
        return result
    said = (
        f"the hand holds {mass:.2f} ± {std:.2f} kg beside what was found, and by least squares "
        f"with friction and offsets alone {plain.mass:.2f} ± {plain.mass_std:.2f} kg"
    )
    return replace(result, notes=(said, *result.notes))


def unnamed(title: str, joints: Sequence[int]) -> str:
    """A note on what is in the model without being told by name."""
    where = f"of joint {joints[0]} " if joints else ""
    return (
        f"the model has a {title} {where}that is no surer than its rivals: it is not told by name"
    )


SURELY = 1.3  # standard deviations: of effects so much larger noise hides one in ten
STEP, OPEN = 1e-3, 100.0  # of a coefficient's prior: for slopes; how wide it is taken here


def unseen(found: Found, joints: Sequence[int]) -> tuple[Unseen, ...]:
    """Of each effect that was not named, and each joint that moves, the least that would be.

    Of effects that last and have one size: not the finer forms of friction, which are sought
    beside a plain one, nor whole bodies.

    Args:
        joints: (from 0) that move.
    """
    fit = found.fit
    told = [k for k in range(len(fit.named)) if k not in found.weak]
    named = {x.candidate.key for k in told for x in (fit.named[k], found.standings[k])}
    table = SignatureTable(fit, joints, rich=False)
    best: dict[tuple[str, int], Unseen] = {}
    for c in table.candidates:
        whole_body = c.columns_are_theta and c.template.theta is None
        usual = c.effect.name in CATALOGUE and not (c.effect.simpler or c.effect.passing)
        if not usual or whole_body or c.key in named:
            continue
        own = _least(c, table.X[list(c.columns)], fit, table.carried)
        if own is None:
            continue
        other = best.setdefault(c.key, own)
        if (own.size > other.size) == own.above:
            best[c.key] = own
    return tuple(best.values())


def _least(c: Candidate, X: Array, fit: Fit, carried: Carried) -> Unseen | None:
    """The least size of an effect with white signatures X (k, r) that is named, all else free.

    None where no size would be that an arm may have.
    """
    form, out = c.effect.form, []  # coefficients carried along: not those of its like on its joint
    for k, e in enumerate(fit.named):
        other = e.candidate
        like = other.key == c.key or (form and other.effect.form == form)
        if other.joint != c.joint or not like:
            out.append(place_of(fit, k))
    first = np.arange(len(fit.coefficients) - sum(len(e.x) for e in fit.named))
    rest = np.concatenate([first, *out])
    G, _ = carried.part(rest).reduced(X @ X.T, X @ carried.N[rest].T, X @ carried.data)
    std, effect = c.prior_std, CATALOGUE[c.effect.name]
    ways = np.linalg.slogdet(np.eye(len(G)) + std[:, None] * G * std)[1]
    asked = max(least_chi2(effect, limited=False), 2.0 * (BELIEF - c.log_odds) + ways)
    asked = SURE**2 if effect is HELD else asked
    covariance = np.linalg.inv(G + np.diag((OPEN * std) ** -2.0))
    key = effect.phrase.key or effect.parameters[0].key

    def value(x: Array) -> float:
        return float(c.template.decode(x)[key])

    at = std / np.arange(1, len(std) + 1)
    slope = np.array([value(at + x) - value(at) for x in STEP * np.diag(std)]) / (STEP * std)
    size = (np.sqrt(asked) + SURELY) * np.sqrt(slope @ covariance @ slope)
    if size > 20.0 * np.linalg.norm(slope * std):  # times its prior: nothing is so large
        return None
    above = len(std) == 1 and slope[0] < 0.0  # what is stiff does not show
    if above:
        size = value((np.sqrt(asked) + SURELY) * np.sqrt(covariance[0]))
    return Unseen(effect.name, c.joint + 1, key, float(size), c.units[key], bool(above))
