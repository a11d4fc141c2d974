"""Learning from a recording: sample by sample as live, or in batches with the same moments."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adapter.effects.torque import ModelTorque
from adapter.errors import SettingsError
from adapter.gap.monitor import Monitor
from adapter.learning.checkpoint import load_checkpoint
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.realtime.timing import Histogram
from adapter.runs.batch import learn_batch
from adapter.runs.config import PipelineSettings
from adapter.runs.contacts import ADOPT_EVERY, ReplayObserver, contacts_of
from adapter.runs.outcome import Outcome, collect
from adapter.runs.pipeline import Pipeline, make_front_end
from adapter.signals.filters import noise_from_samples
from adapter.signals.front_end import FrontEnd
from adapter.signals.records import stamps_of
from adapter.signals.settings import FilterSettings
from adapter.signals.validation import Rms, errors_of_pieces, rms_of, validation_error
from drivers.files.mcap import Log, mapped
from drivers.interface import DriverError

# States that pass the front end in one table: as much as a processor's cache holds. Of the exact
# mode whole times `ADOPT_EVERY`.
AT_ONCE = 2000
BETWEEN_NS = 10**9  # of several recordings, more than any filter bridges
MOST_PER_UPDATE = 50  # ms-samples; more per update leaves ADAM too few steps to arrive

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Replay:
    """What a replay found.

    Attributes:
        outcome: of the learner.
        pipeline: its front end has the counts of refused samples.
        samples: read from the recording.
        ticks: compute times of the front end by sample, means of some (exact mode only).
        wall_s: time spent on learning, without reading the file.
        span_s: time that the samples span in the recording.
        contacts: see `contacts.contacts_of`; of the exact mode and a fixed base only.
    """

    outcome: Outcome
    pipeline: Pipeline
    samples: int
    ticks: Histogram
    wall_s: float
    span_s: float
    contacts: list[dict[str, Any]] = field(default_factory=list)


def one_after_other(logs: Sequence[Log]) -> Log:
    """Recordings of one arm as one, in the order given, with a hole between them.

    The filter starts anew behind the hole, and what the hand carries may have changed in it; all
    that is learned goes on. What links say is kept where every recording has it in memory.

    Args:
        logs: as `matching.matching` returns them, at least one.

    Raises:
        DriverError: one of them holds no samples.
    """
    later_ns: list[int] = []
    end_ns = 0
    for log in logs:
        if not len(log):
            raise DriverError(f"{log.path}: no samples to learn from")
        later_ns.append(end_ns + BETWEEN_NS - log.begin_ns if later_ns else 0)
        end_ns = log.end_ns + later_ns[-1]
    warnings = [text for log in logs for text in log.warnings]
    if not any(log.is_mapped for log in logs):
        return replace(_joined(logs, later_ns), warnings=warnings)
    pairs = zip(logs, later_ns, strict=True)
    own = ((piece, later) for log, later in pairs for piece in log.pieces())
    pieces = (replace(piece, stamp_ns=piece.stamp_ns + later) for piece, later in own)
    return replace(mapped(logs[0], pieces), warnings=warnings)


def _joined(logs: Sequence[Log], later_ns: Sequence[int]) -> Log:
    """The same of recordings in memory, each so much later than it was."""
    stamps = [log.stamp_ns + later for log, later in zip(logs, later_ns, strict=True)]
    kept = {key: [getattr(log, key) for log in logs] for key in ("q", "dq", "tau")}
    alike = len({log.link_names for log in logs}) == 1
    for key in ("twists", "accels"):
        own = [getattr(log, key) for log in logs]
        kept[key] = own if alike and all(x is not None for x in own) else []
    tables: dict[str, Any] = {key: np.concatenate(x) if x else None for key, x in kept.items()}
    return replace(logs[0], stamp_ns=np.concatenate(stamps), **tables, frames=(), commands=None)


class ReplayOptions(NamedTuple):
    """How a recording is learned from.

    Attributes:
        every: samples per update; 1 is the exact mode, which equals the live estimates and is
            watched for disagreements as the live process is.
        until_s: learn only from samples before this time after the first stamp.
        progress: called with the number of samples taken so far.
        resume: a checkpoint to go on from.
        say: takes a sentence on each new disagreement when it is found.
    """

    every: int = 1
    until_s: float | None = None
    progress: Progress | None = None
    resume: Path | None = None
    say: Callable[[str], None] | None = None


def replay(
    log: Log,
    documented: SelfModel,
    settings: PipelineSettings,
    options: ReplayOptions | None = None,
) -> Replay:
    """Learn from a recording (as `matching.matching` returns it).

    Raises:
        SettingsError: `every` out of range, or a checkpoint that does not fit.
        DriverError: no samples, or nothing of the motion of a base that floats.
    """
    every, until_s, progress, resume, say = options or ReplayOptions()
    if not 1 <= every <= MOST_PER_UPDATE:
        raise SettingsError(f"--every takes 1 to {MOST_PER_UPDATE} samples, got {every}")
    stop = len(log)
    if until_s is not None and stop:
        until_ns = log.first_ns + round(1e9 * until_s)
        stop = sum(int(np.sum(piece.stamp_ns < until_ns)) for piece in log.pieces())
    if stop == 0:
        raise DriverError(f"{log.path}: no samples to learn from")
    if documented.tree.floating and log.base is None:
        raise DriverError(
            f"{log.path}: the base of {documented.name} floats, and nothing of its motion was read "
            "(read_log with frames, then frame_topics.with_base_motion)"
        )
    pipeline = Pipeline(documented, settings)
    if every == 1:  # a batch learns of everything before it could tell what is new
        tool = None if documented.tool is None else documented.tool.theta()
        delay_s = pipeline.front_end.delay_s
        if not documented.tree.floating:  # what it knows of disagreements is of a base that rests
            start_s = 1e-9 * float(log.first_ns)
            pipeline.learner.watch = Monitor(documented.tree.n, tool, delay_s, say, start_s)
    if resume is not None:
        load_checkpoint(pipeline.learner, resume)
    observer = None
    if every == 1 and not documented.tree.floating:
        observer = ReplayObserver(documented, pipeline.learner)
    started = time.perf_counter()
    progress = progress or (lambda done: None)
    ticks = Histogram()
    if every == 1:
        ticks = _exact(log, stop, pipeline, progress, observer)
    else:
        tables = filtered_tables(log, stop, pipeline.front_end)
        learn_batch(pipeline.learner, tables, every, progress)
    wall_s = time.perf_counter() - started
    span_s = 1e-9 * float(log.piece(stop - 1, stop).first_ns - log.first_ns)
    contacts = [] if observer is None else contacts_of(observer.observer, documented)
    return Replay(collect(pipeline.learner), pipeline, stop, ticks, wall_s, span_s, contacts)


def _exact(
    log: Log, stop: int, pipeline: Pipeline, progress: Progress, observer: ReplayObserver | None
) -> Histogram:
    ticks = Histogram()
    for start in range(0, stop, AT_ONCE):
        progress(start)
        piece = log.piece(start, min(start + AT_ONCE, stop))
        signals = np.stack([piece.q, piece.dq, piece.tau], axis=1)
        # the observer goes on with what is learned behind every so-many samples
        for begin in range(0, len(piece), ADOPT_EVERY):
            own = slice(begin, min(begin + ADOPT_EVERY, len(piece)))
            part, before = piece.piece(own.start, own.stop), time.perf_counter_ns()
            states = _filtered(part, pipeline.front_end)
            ticks.add((time.perf_counter_ns() - before) // len(part), len(part))
            if len(states):
                pipeline.learner.step_each(states)
            if observer is not None:
                observer.step_each(part.stamp_ns, signals[own])
    return ticks


def filtered_tables(log: Log, stop: int, front_end: FrontEnd) -> Iterator[Array]:
    """Filtered states (m, size) of the first `stop` samples of a recording, a table at a time."""
    at_once = max(AT_ONCE // front_end.filter.settings.states_per_sample, 1)
    for start in range(0, stop, at_once):
        yield _filtered(log.piece(start, min(start + at_once, stop)), front_end)


def _filtered(part: Log, front_end: FrontEnd) -> Array:
    """(k, size) filtered states of a part that follows those before."""
    links = None
    if part.twists is not None and part.accels is not None:
        links = part.twists, part.accels
    joints = part.stamp_ns, part.q, part.dq, part.tau
    return front_end.step_table(*joints, links, part.base)


def fitted_to(log: Log, settings: FilterSettings) -> tuple[FilterSettings, list[str]]:
    """Filter settings for the rate of a recording and, where they leave it open, its noise.

    Of a mapped recording both are told by stretches of it, see `Log.spread`.

    Returns:
        The settings, and a sentence where the recording's rate is not the nominal one.
    """
    steps = np.concatenate([np.diff(part.stamp_ns) for part in log.spread()])
    steps = steps[steps > 0]
    changes: dict[str, float] = {}
    warnings = []
    if len(steps):
        period_s = 1e-9 * float(np.median(steps))
        if not 0.8 < period_s / settings.period_s < 1.25:
            changes["period_s"] = period_s
            widest_hz = FilterSettings(1e-9, period_s=period_s).widest_hz
            changes["bandwidth_hz"] = min(settings.bandwidth_hz, widest_hz)
            warnings.append(
                f"{log.path}: {1.0 / period_s:.0f} samples a second; the filter follows"
            )
    if settings.dq_noise is None and settings.dq_drive is not None:
        noise = float(np.median(noise_levels(log)["dq"]))
        if np.isfinite(noise):
            changes["dq_noise"] = noise
    return replace(settings, **changes), warnings


def noise_levels(log: Log) -> dict[str, Array]:
    """White-noise level (n,) of q, dq and tau of a recording, from its high frequencies.

    Not numbers where there are too few samples, or too few that are not the one before. Of a
    mapped recording it is that of stretches, see `Log.spread`.
    """
    found, told = [_noise_levels(part) for part in log.spread()], {}
    for name in ("q", "dq", "tau"):
        levels = [x[name] for x in found]
        known = [x for x in levels if np.isfinite(x).all()]
        with np.errstate(invalid="ignore"):
            told[name] = np.sqrt(np.mean(np.stack(known or levels[:1]) ** 2, axis=0))
    return told


def _noise_levels(log: Log) -> dict[str, Array]:
    new = np.ones(len(log), dtype=bool)
    new[1:] = (np.diff(log.dq, axis=0) != 0).any(axis=1)
    signals = {"q": log.q, "dq": log.dq, "tau": log.tau}
    if new.sum() < 50:  # samples
        return {name: np.full(log.dq.shape[1], np.nan) for name in signals}
    return {name: noise_from_samples(np.nan_to_num(x[new])) for name, x in signals.items()}


def held_out_rms(log: Log, model: SelfModel, settings: PipelineSettings) -> Rms:
    """Torque error of a model on a recording it has not seen, N m.

    Of a base that floats, on the states that the front end makes of the recording; else by the
    recipe of `validation`.
    """
    if log.is_mapped:
        signals = ((seconds(x, log.first_ns), x.q, x.dq, x.tau) for x in log.pieces())
        return rms_of(errors_of_pieces(signals, ModelTorque(model)))
    if not model.tree.floating:
        error = validation_error(seconds(log), log.q, log.dq, log.tau, ModelTorque(model))
        return rms_of([error])
    front_end = make_front_end(model, settings)
    states = front_end.step_table(log.stamp_ns, log.q, log.dq, log.tau, base=log.base)
    at = front_end.layout
    q, dq, ddq = (states[:, part] for part in (at.q, at.dq, at.ddq))
    t: Array = 1e-9 * (stamps_of(states) - log.first_ns).astype(np.float64)
    return rms_of([states[:, at.joint_tau] - ModelTorque(model, states[:, at.base])(q, dq, ddq, t)])


def seconds(log: Log, since_ns: int | None = None) -> Array:
    """(m,) seconds since the first stamp, or since another one."""
    return 1e-9 * (log.stamp_ns - (log.stamp_ns[0] if since_ns is None else since_ns))


def last_s(log: Log) -> float:
    """Seconds from the first sample of a recording to the last one."""
    return float(seconds(log.piece(len(log) - 1, len(log)), log.first_ns)[0])


def from_s(log: Log, begin_s: float, end_s: float = np.inf) -> Log:
    """Samples of a recording from a time after its first one to another (not included), s."""
    first_ns = log.first_ns

    def part(piece: Log) -> Log:
        at_s = seconds(piece, first_ns)
        return piece.take((at_s >= begin_s) & (at_s < end_s))

    return log.changed(part)
