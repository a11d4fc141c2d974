"""Recordings of others (bags of either ROS, MCAP) turned into one of the project's own.

What is read is what `replay`, `gap` and `info` read of them; written are joint states, commands
and the links' motion that belongs to them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from adapter.model.model_file import whole_file
from adapter.signals.importer import ALL, ImportReport, ImportSpec, imported_by, unit_factor
from adapter.signals.matching import corresponding
from adapter.signals.plausible import refuse_wild, value_doubts, velocity_doubts
from drivers.errors import choices
from drivers.files.mcap import Log, is_recording, read_log, read_position_log, write_log
from drivers.interface import Array, DriverError

_OF_TABLES = {"columns": {}, "flat": False, "period_s": None, "episode": None}  # not given


def of_recording(spec: ImportSpec) -> bool:
    """Whether the source is a recording and not a table.

    Raises:
        DriverError: it is, but stands for one signal; or a topic was named, and it is not.
    """
    for signal, path in spec.sources.items():
        if is_recording(path) and signal != ALL:
            raise DriverError(
                f"{path}: is a recording with all signals; write it without {signal}="
            )
        if is_recording(path):
            return True
        if spec.topic is not None:
            raise DriverError(f"{path}: is no recording, so it has no topic {spec.topic}")
    return False


def import_recording(spec: ImportSpec, out: Path) -> ImportReport:
    """Write a recording from a recording; it appears under its name only when it is complete.

    Raises:
        DriverError: the source cannot be read, has no joint states, or another unit is likely.
    """
    if out.exists() and not spec.overwrite:
        raise DriverError(f"{out}: exists; choose another name or delete it")
    log = position_log(spec)
    log = recording_log(spec) if log is None else log
    metadata = imported_by(spec)
    metadata["imported"]["topic"] = log.topic
    warnings = log.warnings + _left_behind(log)
    with whole_file(out) as part:
        write_log(log, part, metadata)
    return ImportReport.of(out, log.joint_names, log.stamp_ns, warnings)


def recording_log(spec: ImportSpec) -> Log:
    """What a recording says, in SI, its joints those of the specification, if it names any.

    Raises:
        DriverError: like `import_recording`.
    """
    path = _source(spec)
    factors = _factors(spec)
    log, said = _with_joints(read_log(path, topic=spec.topic, frames=True), spec.joint_names)
    q, dq, tau = (
        np.multiply(x, factors[name])
        for name, x in (("q", log.q), ("dq", log.dq), ("tau", log.tau))
    )
    commands = log.commands
    if commands is not None:
        commands = replace(commands, tau=commands.tau * factors["tau"])
    # The reader's doubt about degrees is judged again here, in SI.
    warnings = [x for x in log.warnings if "are these degrees?" not in x] + said
    log = replace(log, q=q, dq=dq, tau=tau, commands=commands, warnings=warnings)
    signals = {"q": q, "dq": dq, "tau": tau}
    log.warnings.extend(_doubts(spec, f"{path}: {log.topic}", signals))
    log.warnings.extend(velocity_doubts(f"{path}: {log.topic}", log.stamp_ns, q, dq))
    return log


def position_log(spec: ImportSpec) -> Log | None:
    """The same of an arm that takes positions and tells no efforts; None of any other."""
    path = _source(spec)
    factor = _factors(spec)["q"]
    log = read_position_log(path, spec.topic)
    if log is None:
        return None
    log, said = _with_joints(log, spec.joint_names)
    assert log.commands is not None and log.commands.q is not None
    commands = replace(log.commands, q=log.commands.q * factor)
    log = replace(log, q=log.q * factor, commands=commands)
    return replace(log, warnings=log.warnings + said + _doubts(spec, str(path), {"q": log.q}))


def _source(spec: ImportSpec) -> Path:
    """The recording. Raises DriverError where options go with it that are for tables."""
    path = Path(spec.sources[ALL])
    given = [name for name, absent in _OF_TABLES.items() if getattr(spec, name) != absent]
    if "time" in spec.units:
        given.append("units time")
    if given:
        raise DriverError(
            f"{path}: is a recording, whose messages have names and stamps; "
            f"--{given[0].removesuffix('_s')} goes with tables"
        )
    return path


def _factors(spec: ImportSpec) -> dict[str, float]:
    return {signal: unit_factor(spec.units, signal) for signal in ("q", "dq", "tau")}


def _with_joints(log: Log, want: tuple[str, ...]) -> tuple[Log, list[str]]:
    """These joints under these names, and what to say where they were called otherwise.

    Names that differ in nothing but what stands before their number mean the same joint.
    """
    if not want:
        return log, []
    found, said = corresponding(want, log.joint_names, "joint")
    missing = [name for name, have in zip(want, found, strict=True) if have is None]
    if missing:
        raise DriverError(
            f"{log.path}: has no joint {', '.join(missing)}; {choices(missing[0], log.joint_names)}"
        )
    chosen = log.select([name for name in found if name is not None])
    return replace(chosen, joint_names=want), [f"{log.path}: {sentence}" for sentence in said]


def _doubts(spec: ImportSpec, where: str, signals: dict[str, Array]) -> list[str]:
    for name, values in signals.items():
        refuse_wild(where, lambda row: f"sample {row}", name, values)
    return value_doubts(where, signals, spec.units)


def _left_behind(log: Log) -> list[str]:
    """A sentence on motion that the recording tells and the copy does not."""
    frames = [m.topic for m in log.frames if m.frame not in log.link_names]
    halves = [] if (log.twists is None) == (log.accels is None) else ["the links' motion (a half)"]
    if not frames + halves:
        return []
    return [
        f"{log.path}: not taken: {', '.join(frames + halves)} (`adapter discover` reads the "
        "recording itself)"
    ]
