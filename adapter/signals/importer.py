"""Files of other tools, as logs, and turned into a recording of the project's own.

Of tables (CSV, one value a line, npz, Parquet, LeRobot) a specification says which file, column
and unit holds which signal. Of recordings joint states, commands and the links' motion are taken.
"""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adapter.model.model_file import whole_file
from adapter.signals import source_signals
from adapter.signals.matching import corresponding, several
from adapter.signals.recording import PLAUSIBLE
from adapter.signals.source_table import lerobot_joints
from drivers.errors import choices
from drivers.files import mcap
from drivers.files.bounded import read_text
from drivers.files.mcap.read import Beside
from drivers.interface import Array, DriverError

_OF_TABLES = {"columns": {}, "flat": False, "period_s": None, "episode": None}  # not given
_MOVING = 1e-2  # rad/s, a median slope below it says nothing
_STEP_S = (5e-5, 0.2)  # a median step outside of these suggests a wrong unit of time
_SAGE = "state_motor", "control"  # files of a folder, .csv or .csv.gz: motion and commands


@dataclass(frozen=True)
class ImportReport:
    """What was written."""

    out: Path
    samples: int
    joint_names: tuple[str, ...]
    duration_s: float
    rate_hz: float
    warnings: list[str]


def import_file(spec: source_signals.ImportSpec, out: Path) -> ImportReport:
    """Write a recording from tables or a recording; complete, or not at all under its name.

    Raises:
        DriverError: a file, column, signal or unit is missing or unreadable, or another unit is
            likely; the sentence names file, line or column, and the choices.
    """
    if out.exists() and not spec.overwrite:
        raise DriverError(f"{out}: exists; choose another name, or --overwrite to replace it")
    try:
        version = importlib.metadata.version("panda-adapter")
    except importlib.metadata.PackageNotFoundError:
        version = "unknown"
    recorded = [
        s for s, x in spec.sources.items() if mcap.is_recording(x) and not is_data_set(Path(x))
    ]
    if any(recorded):
        path = spec.sources[next(filter(None, recorded))]
        raise DriverError(f"{path}: is a recording with all signals; write it without SIGNAL=")
    if spec.topic is not None and not recorded:
        path = next(iter(spec.sources.values()))
        raise DriverError(f"{path}: is no recording, so it has no topic {spec.topic}")
    log = recording_log(spec) if recorded else table_log(spec)
    source = {
        "files": {signal or "all": Path(path).name for signal, path in spec.sources.items()},
        "columns": spec.columns,
        "units": spec.units,
        "topic": log.topic if recorded else None,
    }
    with whole_file(out) as part:
        mcap.write_log(log, part, {"version": version, "imported": source})
    left = [m.topic for m in log.frames if m.frame not in log.link_names]
    if (log.twists is None) != (log.accels is None):
        left.append("the links' motion (a half)")
    stamp_ns, warnings = log.stamp_ns, log.warnings
    if left:  # the recording tells it, and the copy does not
        said = f"not taken: {', '.join(left)} (`adapter discover` reads the recording itself)"
        warnings = [*warnings, f"{log.path}: {said}"]
    duration_s = float(np.ptp(stamp_ns)) * 1e-9 if len(stamp_ns) else 0.0
    rate_hz = (len(stamp_ns) - 1) / duration_s if duration_s > 0 else 0.0
    return ImportReport(out, len(stamp_ns), log.joint_names, duration_s, rate_hz, warnings)


def is_data_set(path: Path) -> bool:
    """Whether a folder is a data set of LeRobot, or a motion of SAGE."""
    return (path / "meta" / "info.json").is_file() or bool(_sage_files(path))


def _sage_files(path: Path) -> list[Path]:
    """Files of motion and commands of a folder that has both."""
    both = [[path / f"{name}.csv{end}" for end in ("", ".gz")] for name in _SAGE]
    found = [next((file for file in files if file.is_file()), None) for files in both]
    return [file for file in found if file is not None] if all(found) else []


def _of_folder(
    spec: source_signals.ImportSpec,
) -> tuple[source_signals.ImportSpec, tuple[str, ...]]:
    """A specification of files where it names a folder, and the joints that this tells."""
    path = Path(spec.sources.get(source_signals.ALL, spec.sources.get("q", "")))
    files = _sage_files(path) if source_signals.ALL in spec.sources else []
    if not files:
        return spec, lerobot_joints(path)
    sources = {"cmd": files[1], **spec.sources, source_signals.ALL: files[0]}
    listed = path / "joint_list.txt"
    names = read_text(listed).split() if listed.is_file() else ()
    return replace(spec, sources=sources, units={"time": "us", **spec.units}), tuple(names)


def is_table(path: Path) -> bool:
    """Whether a path is a table's, or a data set's, and no recording's."""
    table = path.with_suffix("") if path.suffix == ".gz" else path
    ends = (".csv", ".tsv", ".txt", ".dat", ".npz", ".parquet")
    return table.suffix in ends or is_data_set(path)


def read_log(path: str | Path, topic: str | None = None, beside: Beside = "") -> mcap.Log:
    """A recording, or a table whose headers say what it holds. Raises DriverError."""
    if is_table(Path(path)):
        return table_log(source_signals.ImportSpec.from_options([str(path)]))
    return mcap.read_log(path, topic=topic, beside=beside)


def read_position_log(path: Path, topic: str | None = None) -> mcap.Log | None:
    """The same of commands and positions alone; None of a log of another kind."""
    if not is_table(path):
        return mcap.read_position_log(path, topic)
    log = read_log(path)
    return None if log.commands is None or np.isfinite(log.tau).any() else log


def table_log(spec: source_signals.ImportSpec) -> mcap.Log:
    """What tables say, as a recording in memory. Raises DriverError like `import_file`."""
    path = Path(spec.sources.get("q", spec.sources.get(source_signals.ALL, "")))
    spec, own = _of_folder(spec)
    reader = source_signals.SourceReader(spec, own or spec.joint_names)
    stamp_ns, q, dq, tau, commands = source_signals.read_signals(reader, spec)
    units = reader.units
    where, warnings = str(path), reader.said
    names = reader.joint_names or tuple(f"joint{i + 1}" for i in range(q.shape[1]))
    if not reader.joint_names:
        warnings.append(f"{where}: no joint names given; they are called {names[0]} to {names[-1]}")
    if tau is not None and dq is None:
        warnings.append(f"{where}: no velocities; derived from the positions")
    if dq is not None:
        warnings += velocity_doubts(where, stamp_ns, q, dq)
    warnings += _stamp_doubts(units, spec.period_s, where, stamp_ns)
    signals = {"q": q, "dq": dq, "tau": tau}
    there = {name: values for name, values in signals.items() if values is not None}
    warnings += _value_doubts(where, there, units)
    said = " ".join(
        f"{s}={','.join(spec.columns[s])}" for s in source_signals.SIGNALS if s in spec.columns
    )
    log = mcap.Log(
        path,
        names,
        stamp_ns,
        q,
        mcap.derive_velocity(stamp_ns, q) if dq is None else dq,
        np.full_like(q, np.nan) if tau is None else tau,
        commands=commands,
        warnings=warnings,
        topic=f"columns {said}" if said else "columns with the usual names",
    )
    return _with_joints(log, spec)


def recording_log(spec: source_signals.ImportSpec) -> mcap.Log:
    """What a recording says, in SI, its joints those of the specification, if it names any.

    Raises:
        DriverError: like `import_file`; or options go with it that are for tables.
    """
    path = Path(spec.sources[source_signals.ALL])
    given = [name for name, absent in _OF_TABLES.items() if getattr(spec, name) != absent]
    if "time" in spec.units:
        given.append("units time")
    if given:
        said = f"--{given[0].removesuffix('_s')} goes with tables"
        raise DriverError(f"{path}: is a recording, whose messages have names and stamps; {said}")
    factors = {name: source_signals.unit_factor(spec.units, name) for name in ("q", "dq", "tau")}
    found = mcap.read_position_log(path, spec.topic)
    signals = ("q", "dq", "tau") if found is None else ("q",)
    read = mcap.read_log(path, topic=spec.topic, beside="frames") if found is None else found
    # The reader's doubt about degrees is judged again below, in SI.
    doubts = [x for x in read.warnings if "are these degrees?" not in x]
    log = _with_joints(replace(read, warnings=doubts), spec)
    told = {name: np.multiply(getattr(log, name), factors[name]) for name in factors}
    commands = log.commands
    if commands is not None:
        q = None if commands.q is None else commands.q * factors["q"]
        commands = replace(commands, tau=commands.tau * factors["tau"], q=q)
    warnings, where = log.warnings, f"{path}: {log.topic}"
    for name in signals:
        source_signals.refuse_wild(where, "sample {}".format, name, told[name])
    warnings += _value_doubts(where, {name: told[name] for name in signals}, spec.units)
    warnings += velocity_doubts(where, log.stamp_ns, told["q"], told["dq"])
    return replace(log, **told, commands=commands, warnings=warnings)


def _with_joints(log: mcap.Log, spec: source_signals.ImportSpec) -> mcap.Log:
    """The joints wanted under their names, with warnings where they were called otherwise.

    Names that differ in nothing but what stands before their number mean the same joint; where no
    name is the same, and there are as many, the order is taken to be.
    """
    log = replace(log, joint_names=tuple(_renamed(log, spec)))
    want, have = spec.joint_names, log.joint_names
    if not want:
        return log
    found, said = corresponding(want, have, "joint")
    if len(want) == len(have) and not any(found):
        words = [
            [set(re.findall("[a-z]{3,}", x.casefold())) for x in each] for each in (want, have)
        ]
        shared = [[j for j, own in enumerate(words[1]) if own & other] for other in words[0]]
        # words that names share may speak against the order
        if not any(len(at) == 1 and at != [i] for i, at in enumerate(shared)):
            pairs = ", ".join(f"{a} = {b}" for a, b in zip(have, want, strict=True))
            said = [
                f"joint names differ and are matched by their order: {pairs} (else --names A=B,...)"
            ]
            found = list(have)
    missing = [name for name, own in zip(want, found, strict=True) if own is None]
    if missing:
        raise DriverError(
            several(want, log)
            or f"{log.path}: has no joint {', '.join(missing)}; {choices(missing[0], have)} "
            "(--names A=B,... says how they are called)"
        )
    chosen = log.select([name for name in found if name is not None])
    warnings = [*chosen.warnings, *(f"{log.path}: {sentence}" for sentence in said)]
    return replace(chosen, joint_names=want, warnings=warnings)


def _renamed(log: mcap.Log, spec: source_signals.ImportSpec) -> list[str]:
    """Names of the recording's joints as the specification has them. Raises DriverError."""
    have, names = list(log.joint_names), dict(spec.names)
    for told in [name for name in names if name.endswith("*")]:
        start, end = told[:-1], names.pop(told)
        found = [name for name in have if name.startswith(start)]
        names |= {x: end.replace("*", x.removeprefix(start)) for x in found or [told]}
    lacking = [name for name in names if name not in have]
    if lacking:
        raise DriverError(f"{log.path}: has no joint {lacking[0]}; {choices(lacking[0], have)}")
    called = [names.get(name, name) for name in have]
    twice = [name for name in called if called.count(name) > 1]
    if twice:
        raise DriverError(f"{log.path}: --names calls two joints {twice[0]}")
    return called


def _stamp_doubts(
    units: Mapping[str, str], period_s: float | None, where: str, stamp_ns: NDArray[np.int64]
) -> list[str]:
    """Sentences on stamps (m,) that look wrong but can be recorded.

    Raises:
        DriverError: the unit of time was not named, and another is likely.
    """
    found = []
    steps = np.diff(stamp_ns)
    if np.any(steps < 0):
        first = int(np.flatnonzero(steps < 0)[0]) + 1
        found.append(
            f"{where}: time runs backwards {int((steps < 0).sum())} times, first at sample {first}"
        )
    step_s = float(np.median(np.abs(steps))) * 1e-9 if steps.size else _STEP_S[0]
    if not _STEP_S[0] <= step_s <= _STEP_S[1]:
        said = f"{where}: samples are {step_s:.3g} s apart; is the time in"
        told, have = units.get("time"), ", ".join(source_signals.UNITS["time"])
        if told is None and period_s is None:
            raise DriverError(f"{said} s? Say --units time=UNIT ({have}; s takes it as it is)")
        found.append(f"{said} {told or 's'}? (units: {have})")
    return found


def _value_doubts(where: str, signals: Mapping[str, Array], units: Mapping[str, str]) -> list[str]:
    """Sentences on samples that are no number, and on positions that look like degrees.

    Args:
        where: the file; signals: (m, n) by name, SI; units: those that the user named.

    Raises:
        DriverError: positions look like degrees, and their unit was not named.
    """
    found = []
    for name, values in signals.items():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if bad.size:
            found.append(
                f"{where}: {name} is not a number in {bad.size} samples, first in sample {bad[0]}"
            )
    if mcap.looks_like_degrees(signals["q"]):
        said = (
            f"{where}: positions reach {np.nanmax(np.abs(signals['q'])):.0f} rad; are they degrees?"
        )
        if "q" not in units:
            raise DriverError(f"{said} Say --units q=deg (q=rad takes them as they are)")
        found.append(f"{said} Say q=deg")
    return found


def velocity_doubts(where: str, stamp_ns: NDArray[np.int64], q: Array, dq: Array) -> list[str]:
    """Whether the velocities are the positions' slope in the same unit."""
    with np.errstate(invalid="ignore"):
        slopes = np.abs(mcap.derive_velocity(stamp_ns, q))
    if np.isnan(slopes).all() or np.isnan(dq).all():
        return []
    slope, said = np.nanmedian(slopes), np.nanmedian(np.abs(dq))
    ratio = said / slope if slope > _MOVING and said > 0 else 1.0
    if PLAUSIBLE < ratio < 1 / PLAUSIBLE:
        return []
    said = "the slope of the positions; are the units of q, dq and time right?"
    return [f"{where}: velocities are {ratio:.3g} times {said}"]
