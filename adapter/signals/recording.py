"""What `adapter info FILE` says of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drivers.files import mcap
from drivers.interface import Array, DriverError

GAP_S, _HOLE = 0.05, 3.0  # a longer step between samples, and usual steps, is called a gap
_LISTED = 10  # gaps and topics that are listed one by one
_SLIDING_UNIT = {"q_rad": "m", "dq_rad_s": "m/s", "tau_nm": "N"}
_FAST, RESTING = 0.1, 0.02  # rad/s: from which a slope says something, below which a joint rests
PLAUSIBLE = 0.2  # degrees for radians are a factor of 57, milliseconds for seconds of 1000


def describe(
    path: str | Path | mcap.Log, topic: str | None = None, slides: Sequence[str] = ()
) -> dict[str, Any]:
    """A recording's contents and health, ready for JSON.

    Joints that are known to slide are `slides`: their numbers are m, m/s and N under all keys.
    Of a file without usable joint states only its topics are told, and `problem` says what is
    missing. Keys: file, bytes, truncated, problem, topics, warnings; with joint states also
    joints, source (topic or columns of the joint states), units, teaches, links, frames (topics
    that tell the motion of others), samples, samples_judged (of a long recording content is
    judged from a sample, and a warning says so), start_s, duration_s,
    rate_hz, period_ms, jitter_ms, repeated_samples, repeated_stamps, backward_steps, not_finite,
    gaps, range, metadata, attachments; commands (how many), commanded (positions or torques);
    tracking_error_rad, rms of command less position of each joint where there are no efforts;
    slides, the joints that do.

    Raises:
        DriverError: the file is unreadable, empty or not MCAP.
    """
    path, log = (path.path, path) if isinstance(path, mcap.Log) else (Path(path), None)
    try:
        looked = _look(path, log, topic)
    except DriverError as error:
        topics, warnings, truncated = mcap.survey(path)
        facts: dict[str, Any] = {"problem": str(error)}
    else:
        first, warnings = looked.parts[0], looked.warnings
        topics, truncated = first.topics, first.truncated
        own = [name for name in first.joint_names if name in slides]
        facts = {"problem": None, **_joint_facts(looked, own), **_timing(looked), "slides": own}
    return {
        "file": str(path),
        "bytes": sum(p.stat().st_size for p in (path, *path.rglob("*")) if p.is_file()),
        "truncated": truncated,
        "topics": {name: asdict(topic) for name, topic in topics.items()},
        "warnings": warnings,
        **facts,
    }


class _Looked(NamedTuple):
    """What of a recording was looked at.

    Attributes:
        parts: all of it, or stretches in the order of time.
        samples, commands, warnings: of the whole.
        holes: (s since the first sample, s) that are known beside those in the parts.
    """

    parts: list[mcap.Log]
    samples: int
    commands: int
    warnings: list[str]
    holes: list[tuple[float, float]]


def _look(path: Path, log: mcap.Log | None, topic: str | None) -> _Looked:
    """A recording, a long one by a sample. Raises DriverError."""
    sample = mcap.sample_log(path, topic, "frames") if log is None else None
    holes: list[tuple[float, float]] = []
    if sample is None:
        log = _read(path, topic) if log is None else log
        parts, samples, part = log.spread(), len(log), log.is_mapped
        commands = 0 if log.commands is None else len(log.commands.stamp_ns)
    else:
        parts, holes = sample
        log, told, part = parts[0], parts[0].topics.get(mcap.JOINT_COMMANDS), True
        samples = log.topics[log.topic].messages
        commands = 0 if told is None or log.commands is None else told.messages
    judged = (
        f"judged from {sum(map(len, parts))} of {samples} samples, in {len(parts)} stretches from "
        "the first to the last: ranges, units, steps, repeats, holes and what is no number; count "
        "and duration are of the whole"
    )
    return _Looked(parts, samples, commands, [*log.warnings, *([judged] if part else [])], holes)


def _read(path: Path, topic: str | None) -> mcap.Log:
    """A recording, also one of commanded and measured positions alone. Raises DriverError."""
    log, trouble = None, None
    try:
        log = mcap.read_log(path, topic=topic, beside="frames")
    except DriverError as error:
        trouble = error
    if log is None or not (log.is_mapped or np.any(np.nan_to_num(log.tau))):
        try:
            log = mcap.read_position_log(path, topic) or log
        except DriverError as error:  # it found commands, and knows more of what is wrong
            trouble = error
    if log is None:
        assert trouble is not None
        raise trouble
    return log


def _of_servos(log: mcap.Log) -> bool:
    """Whether it tells positions and commanded ones, and no efforts."""
    return log.commands is not None and log.commands.q is not None and bool(np.isnan(log.tau).all())


def summary(facts: dict[str, Any]) -> list[str]:
    """The facts of `describe` in about ten lines."""
    topics = facts["topics"]
    lines = [f"{facts['file']}: {facts['bytes']} bytes{', cut' if facts['truncated'] else ''}"]
    if facts["problem"] is not None:
        lines.append(f"problem: {facts['problem']}")
    else:
        lines += _signal_lines(facts)
    if topics:
        told = [f"{k} ({t['schema'] or t['encoding']}, {t['messages']})" for k, t in topics.items()]
        more = f" and {len(told) - _LISTED} more" if len(told) > _LISTED else ""
        lines.append(f"topics: {', '.join(told[:_LISTED])}{more}")
    return lines + [f"note: {warning}" for warning in facts["warnings"]]


def _signal_lines(facts: dict[str, Any]) -> list[str]:
    gaps, period, rate = facts["gaps"], facts["period_ms"], facts["rate_hz"]
    count = len(facts["joints"])
    steps = ""
    if period is not None:
        longest = f"longest 1 %: {period['p99']:.3g}, longest {period['max']:.3g}"
        steps = f", steps {period['p50']:.3g} ms ({longest})"
    others = [f"{facts['commands']} commanded {facts['commanded']}"] if facts["commands"] else []
    off = [f"{1e3 * x:.3g}" for x in facts["tracking_error_rad"] or ()]
    unit = f"mrad{_sliding(facts, 'mm')}"
    others += [f"motion of {name}" for name in (*facts["links"], *facts["frames"])]
    return [
        f"joints: {count}, {', '.join(facts['joints'])}",
        f"joint states: {facts['source']}; also: {', '.join(others) or 'nothing else'}",
        f"rate: {'unknown' if rate is None else f'{rate:.4g} Hz'}, {facts['samples']} samples, "
        f"{facts['duration_s']:.4g} s{steps}",
        f"holes: {gaps['count']} (longer than {gaps['longer_than_s']:.3g} s), longest step "
        f"{gaps['longest_s']:.3g} s",
        f"repeats: {facts['repeated_samples']} samples, {facts['repeated_stamps']} stamps; "
        f"{facts['backward_steps']} steps back in time; {facts['not_finite']} not a number",
        *(
            f"{name}: {'  '.join(map('{:.3g}..{:.3g}'.format, found['min'], found['max']))}"
            + _sliding(facts, _SLIDING_UNIT[name])
            for name, found in facts["range"].items()
        ),
        *([f"command less position, rms: {'  '.join(off)} {unit}"] if off else []),
        f"units: {facts['units']}",
        f"can teach: {facts['teaches']}",
    ]


def _sliding(facts: dict[str, Any], unit: str) -> str:
    """In which unit a line tells joints that slide; nothing where there are none."""
    return f" ({unit} of {', '.join(facts['slides'])})" if facts["slides"] else ""


def _units(parts: list[mcap.Log], q: Array, dq: Array, tau: Array, slides: Sequence[str]) -> str:
    """What the numbers look like; a joint's torque has no size that all arms share."""
    turning = [name not in slides for name in parts[0].joint_names]
    degrees = mcap.looks_like_degrees(q[:, turning])
    said = ["positions look like degrees" if degrees else "positions rad"]
    if slides:
        said[0] += f" (m of {', '.join(slides)})"
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.abs(np.concatenate([mcap.derive_velocity(x.stamp_ns, x.q) for x in parts]))
        fast = slope > _FAST
        ratio = float(np.median((np.abs(dq) / slope)[fast])) if fast.any() else np.nan
    if _of_servos(parts[0]):
        return f"{said[0]}, no efforts"
    if not np.isfinite(ratio):
        said.append("velocities cannot be judged")
    elif PLAUSIBLE < ratio < 1.0 / PLAUSIBLE:
        said.append("velocities rad/s")
    else:
        said.append(f"velocities {ratio:.3g} times the slope of the positions")
    most = float(np.nanmax(np.abs(tau), initial=0.0))
    return ", ".join([*said, f"efforts up to {most:.3g}, taken as N m{' (N)' * bool(slides)}"])


def _teaches(looked: _Looked, dq: Array, tau: Array) -> str:
    log = looked.parts[0]
    with np.errstate(invalid="ignore"):
        moving = np.abs(dq) > RESTING
    resting = [n for j, n in enumerate(log.joint_names) if not moving[:, j].any()]
    seconds = float(moving.any(axis=1).mean()) * _duration_s(looked)
    said = [f"{seconds:.3g} s of motion"]
    if resting:
        said.append(f"at rest: {', '.join(resting)}")
    if _of_servos(log):
        said.append(
            "no torques: the servos and no inertias; `adapter gap LOG --robot ROBOT` finds gain, "
            "delay and friction of each joint that moves"
        )
        return "; ".join(said)
    if not np.any(np.nan_to_num(tau)):
        said.append("no torques: nothing of inertias and friction")
    if log.twists is None and not log.frames:
        said.append("no link motion is recorded: it is synthesized from the documented lengths")
    return "; ".join([*said, "--robot NAME|FILE predicts the parameters"])


def _joint_facts(looked: _Looked, slides: Sequence[str]) -> dict[str, Any]:
    log, parts = looked.parts[0], looked.parts
    tables = (np.concatenate([getattr(x, key) for x in parts]) for key in ("q", "dq", "tau"))
    signals = dict(zip(("q_rad", "dq_rad_s", "tau_nm"), tables, strict=True))
    q, dq, tau = signals.values()
    judged = ["q", "dq", "tau"]
    tracking_error_rad = None
    if _of_servos(log):
        assert log.commands is not None and log.commands.q is not None
        at = log.commands.holding(log.stamp_ns)
        error = log.commands.q[at[at >= 0]] - log.q[at >= 0]  # a command holds until the next
        tracking_error_rad = np.sqrt(np.mean(error**2, axis=0)).tolist() if len(error) else []
        signals, judged = {"q_rad": q}, ["q"]
        dq = np.concatenate([mcap.derive_velocity(x.stamp_ns, x.q) for x in parts])
    repeated = 0
    for part in parts:
        tables = (getattr(part, key) for key in judged)
        same = [(x[1:] == x[:-1]).all(axis=1) for x in tables]
        repeated += int(np.all(same, axis=0).sum())
    finite = np.all([np.isfinite(v).all(axis=1) for v in signals.values()], axis=0)
    return {
        "joints": list(log.joint_names),
        "source": log.topic,
        "units": _units(parts, q, dq, tau, slides),
        "teaches": _teaches(looked, dq, tau),
        "links": list(log.link_names),
        "frames": [f"{m.topic} ({m.frame})" for m in log.frames if m.frame not in log.link_names],
        "samples": looked.samples,
        "samples_judged": sum(map(len, parts)),
        "commands": looked.commands,
        "commanded": "positions" if log.commands and log.commands.q is not None else "torques",
        "tracking_error_rad": tracking_error_rad,
        "repeated_samples": repeated,
        "not_finite": int((~finite).sum()),
        "range": {
            name: {k: getattr(v[finite], k)(axis=0).tolist() for k in ("min", "max")}
            for name, v in signals.items()
            if finite.any()
        },
        "metadata": log.metadata,
        "attachments": {name: len(data) for name, data in log.attachments.items()},
    }


def _duration_s(looked: _Looked) -> float:
    stamps = [part.stamp_ns for part in looked.parts]
    return 1e-9 * float(max(x.max() for x in stamps) - min(x.min() for x in stamps))


def _timing(looked: _Looked) -> dict[str, Any]:
    steps_ns = np.concatenate([np.diff(part.stamp_ns) for part in looked.parts])
    steps_ms, steps_s = steps_ns * 1e-6, steps_ns * 1e-9
    forward = steps_ms[steps_ms > 0]
    duration_s = _duration_s(looked)
    facts: dict[str, Any] = {
        "start_s": float(looked.parts[0].stamp_ns[0]) * 1e-9,
        "duration_s": duration_s,
        "rate_hz": (looked.samples - 1) / duration_s if duration_s > 0 else None,
        "repeated_stamps": int((steps_ms == 0).sum()),
        "backward_steps": int((steps_ms < 0).sum()),
        "period_ms": None,
        "jitter_ms": None,
    }
    hole_s = GAP_S
    if forward.size:
        shares = {"min": 0, "p50": 50, "p99": 99, "max": 100}
        facts["period_ms"] = {k: float(np.percentile(forward, v)) for k, v in shares.items()}
        facts["jitter_ms"] = float(np.std(forward))
        hole_s = max(GAP_S, _HOLE * float(np.median(steps_s[steps_s > 0])))
    between = np.array(looked.holes).reshape(-1, 2)
    first = looked.parts[0].stamp_ns[0]
    after_s = np.concatenate([part.stamp_ns[:-1] - first for part in looked.parts]) * 1e-9
    steps_s, after_s = np.r_[steps_s, between[:, 1]], np.r_[after_s, between[:, 0]]
    places = np.flatnonzero(steps_s >= hole_s)
    places = places[np.argsort(after_s[places], kind="stable")]
    listed = [
        {"after_s": float(after_s[i]), "length_s": float(steps_s[i])} for i in places[:_LISTED]
    ]
    count, longest_s = int(places.size), float(steps_s.max(initial=0))
    gaps = {"longer_than_s": hole_s, "count": count, "longest_s": longest_s, "first": listed}
    return {**facts, "gaps": gaps}
