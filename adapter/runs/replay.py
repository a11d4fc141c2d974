"""Learning from a recording: sample by sample as live, or in batches with the same moments."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adapter.effects.torque import ModelTorque
from adapter.errors import SettingsError
from adapter.gap.monitor import Monitor
from adapter.learning.checkpoint import load_checkpoint
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.runs.batch import learn_batch
from adapter.runs.config import PipelineSettings
from adapter.runs.contacts import ReplayObserver, contacts_of
from adapter.runs.outcome import Outcome, collect
from adapter.runs.pipeline import Pipeline, make_front_end
from adapter.signals.filters import noise_from_samples
from adapter.signals.front_end import FrontEnd
from adapter.signals.settings import FilterSettings
from adapter.signals.validation import validation_error
from drivers.files.mcap import Log
from drivers.interface import DriverError, JointSample, LinkMotion

FEWEST_FOR_NOISE = 50  # samples
AT_ONCE = 2000  # states that pass the front end in one table: as much as a processor's cache holds
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
        tick_ns: compute time of the front end by sample (exact mode only).
        wall_s: time spent on learning, without reading the file.
        span_s: time that the samples span in the recording.
        contacts: see `contacts.contacts_of`; of the exact mode and a fixed base only.
    """

    outcome: Outcome
    pipeline: Pipeline
    samples: int
    tick_ns: NDArray[np.int64]
    wall_s: float
    span_s: float
    contacts: list[dict[str, Any]] = field(default_factory=list)


def one_after_other(logs: Sequence[Log]) -> Log:
    """Recordings of one arm as one, in the order given, with a hole between them.

    The filter starts anew behind the hole, and what the hand carries may have changed in it; all
    that is learned goes on. What links say is kept where every recording has it.

    Args:
        logs: as `matching.matching` returns them, at least one.

    Raises:
        DriverError: one of them holds no samples.
    """
    stamps: list[NDArray[np.int64]] = []
    for log in logs:
        if not len(log):
            raise DriverError(f"{log.path}: no samples to learn from")
        first = int(log.stamp_ns.min())
        begin = int(stamps[-1].max()) + BETWEEN_NS if stamps else first
        stamps.append(log.stamp_ns - first + begin)
    kept = {key: [getattr(log, key) for log in logs] for key in ("q", "dq", "tau")}
    alike = len({log.link_names for log in logs}) == 1
    for key in ("twists", "accels"):
        own = [getattr(log, key) for log in logs]
        kept[key] = own if alike and all(x is not None for x in own) else []
    tables: dict[str, Any] = {key: np.concatenate(x) if x else None for key, x in kept.items()}
    warnings = [text for log in logs for text in log.warnings]
    left: dict[str, Any] = {"frames": (), "commands": None, "warnings": warnings}
    return replace(logs[0], stamp_ns=np.concatenate(stamps), **tables, **left)


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
        stop = int(np.sum(log.stamp_ns < log.stamp_ns[0] + round(1e9 * until_s)))
    if stop == 0:
        raise DriverError(f"{log.path}: no samples to learn from")
    if documented.tree.floating and log.base is None:
        raise DriverError(
            f"{log.path}: the base of {documented.name} floats, and nothing of its motion was read "
            "(read_log with frames, then base_motion.with_base_motion)"
        )
    pipeline = Pipeline(documented, settings)
    if every == 1:  # a batch learns of everything before it could tell what is new
        tool = None if documented.tool is None else documented.tool.theta()
        delay_s = pipeline.front_end.delay_s
        if not documented.tree.floating:  # what it knows of disagreements is of a base that rests
            start_s = 1e-9 * float(log.stamp_ns[0])
            pipeline.learner.watch = Monitor(documented.tree.n, tool, delay_s, say, start_s)
    if resume is not None:
        load_checkpoint(pipeline.learner, resume)
    observer = None
    if every == 1 and not documented.tree.floating:
        observer = ReplayObserver(documented, pipeline.learner)
    started = time.perf_counter()
    progress = progress or (lambda done: None)
    if every == 1:
        tick_ns = _exact(log, stop, pipeline, progress, observer)
    else:
        tick_ns = _batch(log, stop, pipeline, every, progress)
    wall_s = time.perf_counter() - started
    span_s = 1e-9 * float(log.stamp_ns[stop - 1] - log.stamp_ns[0])
    contacts = [] if observer is None else contacts_of(observer.observer, documented)
    return Replay(collect(pipeline.learner), pipeline, stop, tick_ns, wall_s, span_s, contacts)


def _exact(
    log: Log,
    stop: int,
    pipeline: Pipeline,
    progress: Progress,
    observer: ReplayObserver | None,
) -> NDArray[np.int64]:
    tick_ns = np.zeros(stop, dtype=np.int64)
    front_end, learner = pipeline.front_end, pipeline.learner
    heard = _heard(log)
    for i in range(stop):
        links = None
        if heard is not None and heard[i] and log.twists is not None and log.accels is not None:
            links = LinkMotion(log.twists[i], log.accels[i])
        joints = log.q[i], log.dq[i], log.tau[i]
        base = None if log.base is None else log.base[i]
        sample = JointSample(int(log.stamp_ns[i]), *joints, links, base)
        before = time.perf_counter_ns()
        states = front_end.step(sample)
        tick_ns[i] = time.perf_counter_ns() - before
        for state in states:
            learner.step(state)
        if observer is not None:
            observer.step(sample)
        if i % 500 == 0:
            progress(i)
    return tick_ns


def _heard(log: Log) -> NDArray[np.bool_] | None:
    if log.twists is None or log.accels is None:
        return None
    silent = np.isnan(log.twists).all(axis=(1, 2)) & np.isnan(log.accels).all(axis=(1, 2))
    return np.asarray(~silent)


def _batch(
    log: Log, stop: int, pipeline: Pipeline, every: int, progress: Progress
) -> NDArray[np.int64]:
    learn_batch(pipeline.learner, filtered_tables(log, stop, pipeline.front_end), every, progress)
    return np.zeros(0, dtype=np.int64)


def filtered_tables(log: Log, stop: int, front_end: FrontEnd) -> Iterator[Array]:
    """Filtered states (m, size) of the first `stop` samples of a recording, a table at a time."""
    at_once = max(AT_ONCE // front_end.filter.settings.states_per_sample, 1)
    for start in range(0, stop, at_once):
        part = slice(start, min(start + at_once, stop))
        links = None
        if log.twists is not None and log.accels is not None:
            links = log.twists[part], log.accels[part]
        joints = log.stamp_ns[part], log.q[part], log.dq[part], log.tau[part]
        base = None if log.base is None else log.base[part]
        yield front_end.step_table(*joints, links, base)


def fitted_to(log: Log, settings: FilterSettings) -> tuple[FilterSettings, list[str]]:
    """Filter settings for the rate of a recording and, where they leave it open, its noise.

    Returns:
        The settings, and a sentence where the recording's rate is not the nominal one.
    """
    steps = np.diff(log.stamp_ns)
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

    Not numbers where there are too few samples, or too few that are not the one before.
    """
    new = np.ones(len(log), dtype=bool)
    new[1:] = (np.diff(log.dq, axis=0) != 0).any(axis=1)
    if new.sum() < FEWEST_FOR_NOISE:
        return {name: np.full(log.dq.shape[1], np.nan) for name in ("q", "dq", "tau")}
    return {
        name: noise_from_samples(np.nan_to_num(getattr(log, name)[new]))
        for name in ("q", "dq", "tau")
    }


def held_out_error(log: Log, model: SelfModel, settings: PipelineSettings) -> Array:
    """Torque error (k, n) of a model on a recording it has not seen, N m.

    Of a base that floats, on the states that the front end makes of the recording; else by the
    recipe of `validation`.
    """
    if not model.tree.floating:
        signals = seconds(log), log.q, log.dq, log.tau
        return validation_error(*signals, ModelTorque(model))
    front_end = make_front_end(model, settings)
    states = front_end.step_table(log.stamp_ns, log.q, log.dq, log.tau, base=log.base)
    at = front_end.layout
    q, dq, ddq = (states[:, part] for part in (at.q, at.dq, at.ddq))
    error = states[:, at.joint_tau] - ModelTorque(model, states[:, at.base])(q, dq, ddq)
    return np.asarray(error)


def seconds(log: Log) -> Array:
    """(m,) seconds since the first stamp."""
    return 1e-9 * (log.stamp_ns - log.stamp_ns[0])
