"""What `adapter info FILE` says of a recording."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.files.mcap import Log, read_log, survey
from drivers.interface import DriverError

GAP_S = 0.05  # a longer step between samples is called a gap
_LISTED = 10  # gaps that are listed one by one


def describe(path: str | Path) -> dict[str, Any]:
    """A recording's contents and health, ready for JSON.

    Of a file without usable joint states only its topics are told, and `problem` says what is
    missing. Keys: file, bytes, truncated, problem, topics, warnings; with joint states also
    joints, links, frames (topics that tell the motion of others), samples, start_s, duration_s,
    rate_hz, period_ms, jitter_ms, repeated_samples, repeated_stamps, backward_steps, not_finite,
    gaps, range, metadata, attachments.

    Raises:
        DriverError: the file is unreadable, empty or not MCAP.
    """
    path = Path(path)
    try:
        log = read_log(path, frames=True)
    except DriverError as error:
        topics, warnings, truncated = survey(path)
        facts: dict[str, Any] = {"problem": str(error)}
    else:
        topics, warnings, truncated = log.topics, log.warnings, log.truncated
        facts = {"problem": None, **_joint_facts(log), **_timing(log)}
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "truncated": truncated,
        "topics": {name: asdict(topic) for name, topic in topics.items()},
        "warnings": warnings,
        **facts,
    }


def _joint_facts(log: Log) -> dict[str, Any]:
    signals = {"q_rad": log.q, "dq_rad_s": log.dq, "tau_nm": log.tau}
    finite = np.all([np.isfinite(v).all(axis=1) for v in signals.values()], axis=0)
    return {
        "joints": list(log.joint_names),
        "links": list(log.link_names),
        "frames": [f"{m.topic} ({m.frame})" for m in log.frames if m.frame not in log.link_names],
        "samples": len(log),
        "commands": 0 if log.commands is None else len(log.commands.stamp_ns),
        "repeated_samples": int(_repeated(log).sum()),
        "not_finite": int((~finite).sum()),
        "range": {
            name: {"min": _listed(v[finite].min(axis=0)), "max": _listed(v[finite].max(axis=0))}
            for name, v in signals.items()
            if finite.any()
        },
        "metadata": log.metadata,
        "attachments": {name: len(data) for name, data in log.attachments.items()},
    }


def _repeated(log: Log) -> NDArray[np.bool_]:
    """(m - 1,) whether a sample is the one before in all of q, dq and tau."""
    same = [(v[1:] == v[:-1]).all(axis=1) for v in (log.q, log.dq, log.tau)]
    repeated: NDArray[np.bool_] = np.all(same, axis=0)
    return repeated


def _timing(log: Log) -> dict[str, Any]:
    stamps = log.stamp_ns
    steps_ms = np.diff(stamps) * 1e-6
    forward = steps_ms[steps_ms > 0]
    duration_s = float(np.ptp(stamps)) * 1e-9
    facts: dict[str, Any] = {
        "start_s": float(stamps[0]) * 1e-9,
        "duration_s": duration_s,
        "rate_hz": (len(stamps) - 1) / duration_s if duration_s > 0 else None,
        "repeated_stamps": int((steps_ms == 0).sum()),
        "backward_steps": int((steps_ms < 0).sum()),
        "period_ms": None,
        "jitter_ms": None,
        "gaps": _gaps(stamps),
    }
    if forward.size:
        shares = {"min": 0, "p50": 50, "p99": 99, "max": 100}
        facts["period_ms"] = {k: float(np.percentile(forward, v)) for k, v in shares.items()}
        facts["jitter_ms"] = float(np.std(forward))
    return facts


def _gaps(stamps: NDArray[np.int64]) -> dict[str, Any]:
    steps_s = np.diff(stamps) * 1e-9
    places = np.flatnonzero(steps_s >= GAP_S)
    listed = [
        {"after_s": float(stamps[i] - stamps[0]) * 1e-9, "length_s": float(steps_s[i])}
        for i in places[:_LISTED]
    ]
    return {"count": int(places.size), "longest_s": float(steps_s.max(initial=0)), "first": listed}


def _listed(values: NDArray[np.float64]) -> list[float]:
    return [float(v) for v in values]
