"""Files of other tools, turned into a recording of the project's own.

Tables: a specification says which file, column and unit holds which signal; they are number files
as other tools write them (CSV, whitespace, one value a line, npz, Parquet, LeRobot). Recordings
(bags of either ROS, MCAP): what is read is what `replay`, `gap` and `info` read of them; written
are joint states, commands and the links' motion that belongs to them. The report says what looks
doubtful.
"""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.model.model_file import whole_file
from adapter.signals.matching import corresponding
from adapter.signals.source_table import (
    SourceTable,
    lerobot_joints,
    read_npz,
    read_parquet,
    read_table,
)
from drivers.errors import choices
from drivers.files.mcap import (
    Log,
    derive_velocity,
    is_recording,
    looks_like_degrees,
    read_log,
    read_position_log,
    write_log,
)
from drivers.interface import Array, DriverError

SIGNALS = ("time", "q", "dq", "tau")
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "q": {"rad": 1.0, "deg": np.pi / 180},
    "dq": {"rad": 1.0, "deg": np.pi / 180},
    "tau": {"Nm": 1.0, "mNm": 1e-3},
}
ALL = ""  # the source of every signal that has none of its own
_USUAL = {  # what signals are called where the user doesn't say
    "time": ("time", "times", "t", "stamp", "timestamp"),
    "q": ("q", "positions", "position", "q[0-9]*", "q_*", "position*", "observation.state"),
    "dq": (
        *("dq", "velocities", "velocity", "dq[0-9]*", "dq_*", "velocity*"),
        "observation.velocity",
    ),
    "tau": (
        *("tau", "torques", "efforts", "effort", "tau[0-9]*", "tau_*", "torque*", "effort*"),
        *("observation.effort", "observation.torque"),
    ),
}
_OF_TABLES = {"columns": {}, "flat": False, "period_s": None, "episode": None}  # not given
_MOST = {"time": 9e9, "q": 1e4, "dq": 1e6, "tau": 1e6}  # SI; beyond, it is another quantity
_WHAT = {"time": "time", "q": "angle", "dq": "velocity", "tau": "torque"}
_MOVING = 1e-2  # rad/s, a median slope below it says nothing
_PLAUSIBLE = 0.2  # degrees for radians are a factor of 57, milliseconds for seconds of 1000
_STEP_S = (5e-5, 0.2)  # a median step outside of these suggests a wrong unit of time


@dataclass(frozen=True)
class ImportSpec:
    """Where each signal is, and in which unit.

    Attributes:
        sources: a file for each signal (time, q, dq, tau), "" for those without their own. Text
            tables (packed by gzip or not), .npz, .parquet, or the folder of a LeRobot data set.
        columns: selectors of each signal in its file (`SourceTable.columns`), or the key
            in an .npz. Where absent: the usual names, or the whole of a signal's own file.
        units: time s, ms, us, ns; q rad, deg; dq rad, deg (per second; that of q where absent);
            tau Nm, mNm.
        joint_names: in the order of the columns; joint1, joint2, ... where empty.
        flat: files have one value a line, sample after sample (found out where time is a file).
        period_s: of the samples, where there is no time.
        overwrite: replace an existing recording.
        episode: of a data set with several.
        topic: of the joint states, where the source is a recording.
    """

    sources: Mapping[str, Path]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    joint_names: tuple[str, ...] = ()
    flat: bool = False
    period_s: float | None = None
    overwrite: bool = False
    episode: int | None = None
    topic: str | None = None

    @classmethod
    def from_options(
        cls, sources: Sequence[str], columns: str = "", units: str = "", **other: Any
    ) -> ImportSpec:
        """From a command line.

        Args:
            sources: `FILE`, or `SIGNAL=FILE` for each signal.
            columns: `time=0,q=1:8,dq=8:15,tau=tau1,tau2,...`.
            units: `q=deg,tau=mNm,time=ms`.
            other: the other attributes.

        Raises:
            DriverError: a signal or unit that doesn't exist; names the choices.
        """
        files: dict[str, Path] = {}
        for source in sources:
            match = re.fullmatch(rf"({'|'.join((*SIGNALS, 't'))})=(.+)", source)
            signal, path = (_signal(match[1]), match[2]) if match else (ALL, source)
            if signal in files:
                what = signal or "all signals"
                raise DriverError(f"{files[signal]} and {path}: are both for {what}; give one file")
            files[signal] = Path(path)
        chosen = {signal: words[0] for signal, words in _assignments(units, "unit").items()}
        return cls(files, _assignments(columns, "column"), chosen, **other)


def _signal(name: str) -> str:
    return "time" if name == "t" else name


def _assignments(text: str, what: str) -> dict[str, tuple[str, ...]]:
    """`a=1,2,b=x` as {a: (1, 2), b: (x,)}."""
    found: dict[str, list[str]] = {}
    current: list[str] | None = None
    for word in filter(None, (w.strip() for w in text.split(","))):
        name, equals, value = word.partition("=")
        if equals:
            if _signal(name) not in SIGNALS:
                raise DriverError(f"no signal '{name}' for a {what}; {choices(name, SIGNALS)}")
            current = found.setdefault(_signal(name), [])
            current.append(value)
        elif current is None:
            raise DriverError(f"{what} '{word}' belongs to no signal; write SIGNAL={word}")
        else:
            current.append(word)
    return {name: tuple(words) for name, words in found.items()}


def unit_factor(units: Mapping[str, str], signal: str) -> float:
    """From a signal's unit to SI. Raises DriverError where there is no such unit."""
    usual = units.get("q", "rad") if signal == "dq" else next(iter(UNITS[signal]))
    unit = units.get(signal, usual)
    if unit not in UNITS[signal]:
        raise DriverError(f"no unit '{unit}' for {signal}; {choices(unit, UNITS[signal])}")
    return UNITS[signal][unit]


@dataclass(frozen=True)
class ImportReport:
    """What was written."""

    out: Path
    samples: int
    joint_names: tuple[str, ...]
    duration_s: float
    rate_hz: float
    warnings: list[str]


def import_file(spec: ImportSpec, out: Path) -> ImportReport:
    """Write a recording from tables or a recording; complete, or not at all under its name.

    Raises:
        DriverError: a file, column, signal or unit is missing or unreadable, or another unit is
            likely; the sentence names file, line or column, and the choices.
    """
    if out.exists() and not spec.overwrite:
        raise DriverError(f"{out}: exists; choose another name or delete it")
    try:
        version = importlib.metadata.version("panda-adapter")
    except importlib.metadata.PackageNotFoundError:
        version = "unknown"
    recorded = False
    for signal, path in spec.sources.items():
        if is_recording(path) and signal != ALL:
            raise DriverError(
                f"{path}: is a recording with all signals; write it without {signal}="
            )
        recorded = recorded or is_recording(path)
        if spec.topic is not None and not recorded:
            raise DriverError(f"{path}: is no recording, so it has no topic {spec.topic}")
    log = recording_log(spec, positions=True) if recorded else table_log(spec)
    source = {
        "files": {signal or "all": Path(path).name for signal, path in spec.sources.items()},
        "columns": spec.columns,
        "units": spec.units,
        "topic": log.topic if recorded else None,
    }
    with whole_file(out) as part:
        write_log(log, part, {"version": version, "imported": source})
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


def table_log(spec: ImportSpec) -> Log:
    """What tables say, as a recording in memory. Raises DriverError like `import_file`."""
    warnings: list[str] = []
    reader = _Reader(spec)
    source = reader.source("q")
    if not spec.joint_names and source is not None:
        spec = replace(spec, joint_names=lerobot_joints(source))
    stamp_ns, q, dq, tau = _signals(reader, spec)
    names = spec.joint_names or tuple(f"joint{i + 1}" for i in range(q.shape[1]))
    where = str(source)
    if not spec.joint_names:
        warnings.append(f"{where}: no joint names given; they are called {names[0]} to {names[-1]}")
    if dq is None:
        dq = derive_velocity(stamp_ns, q)
        warnings.append(f"{where}: no velocities; derived from the positions")
    else:
        warnings += velocity_doubts(where, stamp_ns, q, dq)
    warnings += _stamp_doubts(spec, where, stamp_ns)
    warnings += _value_doubts(where, {"q": q, "dq": dq, "tau": tau}, spec.units)
    said = " ".join(f"{s}={','.join(spec.columns[s])}" for s in SIGNALS if s in spec.columns)
    topic = f"columns {said}" if said else "columns with the usual names"
    return Log(Path(where), names, stamp_ns, q, dq, tau, warnings=warnings, topic=topic)


def recording_log(spec: ImportSpec, positions: bool = False) -> Log:
    """What a recording says, in SI, its joints those of the specification, if it names any.

    Args:
        positions: take also one of an arm that takes positions and tells no efforts.

    Raises:
        DriverError: like `import_file`; or options go with it that are for tables.
    """
    path = Path(spec.sources[ALL])
    given = [name for name, absent in _OF_TABLES.items() if getattr(spec, name) != absent]
    if "time" in spec.units:
        given.append("units time")
    if given:
        raise DriverError(
            f"{path}: is a recording, whose messages have names and stamps; "
            f"--{given[0].removesuffix('_s')} goes with tables"
        )
    factors = {name: unit_factor(spec.units, name) for name in ("q", "dq", "tau")}
    found = read_position_log(path, spec.topic) if positions else None
    signals = ("q", "dq", "tau") if found is None else ("q",)
    read = read_log(path, topic=spec.topic, beside="frames") if found is None else found
    log, said = _with_joints(read, spec.joint_names)
    told = {name: np.multiply(getattr(log, name), factors[name]) for name in factors}
    commands = log.commands
    if commands is not None:
        q = None if commands.q is None else commands.q * factors["q"]
        commands = replace(commands, tau=commands.tau * factors["tau"], q=q)
    # The reader's doubt about degrees is judged again here, in SI.
    warnings = [x for x in log.warnings if "are these degrees?" not in x] + said
    where = f"{path}: {log.topic}"
    for name in signals:
        _refuse_wild(where, lambda row: f"sample {row}", name, told[name])
    warnings += _value_doubts(where, {name: told[name] for name in signals}, spec.units)
    warnings += velocity_doubts(where, log.stamp_ns, told["q"], told["dq"])
    return replace(log, **told, commands=commands, warnings=warnings)


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


class _Reader:
    """Finds signals in files; each file is read once."""

    def __init__(self, spec: ImportSpec) -> None:
        asked = (*spec.sources, *spec.columns, *spec.units)
        unknown = [s for s in asked if s not in SIGNALS and s != ALL]
        if unknown:
            raise DriverError(f"no signal '{unknown[0]}'; {choices(unknown[0], SIGNALS)}")
        self._spec = spec
        self._tables: dict[Path, SourceTable] = {}
        self._arrays: dict[Path, dict[str, Array]] = {}

    def source(self, signal: str) -> Path | None:
        """The file of a signal."""
        path = self._spec.sources.get(signal, self._spec.sources.get(ALL))
        return None if path is None else Path(path)

    def read(self, signal: str) -> Array | None:
        """(m, k) values in SI units; None where the signal isn't there and wasn't asked for."""
        path = self.source(signal)
        factor = unit_factor(self._spec.units, signal)
        if path is None:
            return None
        values = self._npz(path, signal) if path.suffix == ".npz" else self._text(path, signal)
        if values is None:
            return None
        with np.errstate(over="ignore"):
            values = values * factor
        table = self._tables.get(path)
        place = table.place if table is not None else (lambda row: f"row {row}")
        _refuse_wild(str(path), place, signal, values)
        return values

    def need(self, signal: str) -> Array:
        """Like `read`. Raises DriverError where the signal isn't there."""
        values = self.read(signal)
        if values is not None:
            return values
        path = self.source(signal)
        if path is None:
            have = ", ".join(f"{s}={p}" for s, p in self._spec.sources.items())
            raise DriverError(f"no file for {signal} (have: {have or 'none'}); add {signal}=FILE")
        if path in self._arrays:
            having = f"its arrays: {', '.join(self._arrays[path])}"
        else:
            table = self._tables[path]
            having = f"its columns: {', '.join(table.names) or f'0 to {len(table) - 1}'}"
        raise DriverError(f"{path}: which column is {signal}? Name it, {signal}=...; {having}")

    def _text(self, path: Path, signal: str) -> Array | None:
        if path not in self._tables:
            packed = path.suffix == ".parquet" or path.is_dir()
            self._tables[path] = (
                read_parquet(path, self._spec.episode) if packed else read_table(path)
            )
        table = self._tables[path]
        if signal in self._spec.columns:
            return table.columns(self._spec.columns[signal], signal)
        if signal in self._spec.sources:
            return table.values
        return next((table.columns([u], signal) for u in _USUAL[signal] if table.has(u)), None)

    def _npz(self, path: Path, signal: str) -> Array | None:
        if path not in self._arrays:
            self._arrays[path] = read_npz(path)
        arrays = self._arrays[path]
        keys = self._spec.columns.get(signal)
        if keys is None:
            keys = tuple(u for u in _USUAL[signal] if u in arrays)[:1]
        elif len(keys) != 1 or keys[0] not in arrays:
            raise DriverError(
                f"{path}: no array '{','.join(keys)}' for {signal}; have: {', '.join(arrays)}"
            )
        if not keys:
            return None
        values = arrays[keys[0]]
        if values.ndim > 2:
            raise DriverError(f"{path}: {keys[0]} has {values.ndim} dimensions, need 1 or 2")
        return values.reshape(len(values), -1)


def _signals(
    reader: _Reader, spec: ImportSpec
) -> tuple[NDArray[np.int64], Array, Array | None, Array]:
    """Stamps (m,) and q, dq, tau (m, n), checked against one another."""
    times = reader.read("time")
    if times is None and spec.period_s is None:
        reader.need("time")
    q, dq, tau = reader.need("q"), reader.read("dq"), reader.need("tau")
    if times is not None and times.shape[1] != 1:
        raise DriverError(f"{reader.source('time')}: time has {times.shape[1]} columns, need 1")
    samples = len(q) if times is None else len(times)
    if times is None and spec.flat:
        if not spec.joint_names:
            raise DriverError(
                f"{reader.source('q')}: how many values make a sample? Name the joints, or a time "
                "file"
            )
        samples = q.size // len(spec.joint_names)
    q, tau = _shape(reader, "q", q, samples), _shape(reader, "tau", tau, samples)
    dq = None if dq is None else _shape(reader, "dq", dq, samples)
    count = len(spec.joint_names) or q.shape[1]
    for signal, values in (("q", q), ("dq", dq), ("tau", tau)):
        if values is not None and values.shape[1] != count:
            raise DriverError(
                f"{reader.source(signal)}: {signal} has {values.shape[1]} columns for {count} "
                f"joints ({', '.join(spec.joint_names) or 'as many as q has columns'})"
            )
    seconds = np.arange(samples) * (spec.period_s or 0.0) if times is None else times[:, 0]
    bad = np.flatnonzero(~np.isfinite(seconds))
    if bad.size:
        raise DriverError(f"{reader.source('time')}: the time of sample {bad[0]} is not a number")
    return np.round(seconds * 1e9).astype(np.int64), q, dq, tau


def _shape(reader: _Reader, signal: str, values: Array, samples: int) -> Array:
    """(samples, n); a single column of n values a sample is cut into rows."""
    if len(values) == samples:
        return values
    if values.shape[1] == 1 and samples and values.size % samples == 0:
        return values.reshape(samples, -1)
    raise DriverError(
        f"{reader.source(signal)}: {signal} has {len(values)} lines of {values.shape[1]} values "
        f"for {samples} samples; need as many lines, or one value a line and a whole number a "
        "sample"
    )


def _stamp_doubts(spec: ImportSpec, where: str, stamp_ns: NDArray[np.int64]) -> list[str]:
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
        told = spec.units.get("time")
        if told is None and spec.period_s is None:
            raise DriverError(
                f"{said} s? Say --units time=UNIT ({', '.join(UNITS['time'])}; s takes it as it is)"
            )
        found.append(f"{said} {told or 's'}? (units: {', '.join(UNITS['time'])})")
    return found


def _refuse_wild(where: str, place: Callable[[int], str], signal: str, values: Array) -> None:
    """Refuse numbers that no arm has.

    Args:
        where: the file; place: what stands at a row of it, in words.
        signal: time, q, dq or tau; values: (m, k), SI.

    Raises:
        DriverError: one is larger than any of its kind; names the first.
    """
    wild = np.argwhere(np.abs(values) > _MOST[signal])
    if len(wild):
        row, column = wild[0].tolist()
        raise DriverError(
            f"{where}: {place(row)}: {values[row, column]:.4g} is no {_WHAT[signal]} (at most "
            f"{_MOST[signal]:g} in SI units); are column and unit of {signal} right?"
        )


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
    if looks_like_degrees(signals["q"]):
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
        slopes = np.abs(derive_velocity(stamp_ns, q))
    if np.isnan(slopes).all() or np.isnan(dq).all():
        return []
    slope, said = np.nanmedian(slopes), np.nanmedian(np.abs(dq))
    ratio = said / slope if slope > _MOVING and said > 0 else 1.0
    if _PLAUSIBLE < ratio < 1 / _PLAUSIBLE:
        return []
    return [
        f"{where}: velocities are {ratio:.3g} times the slope of the positions; are the units "
        "of q, dq and time right?"
    ]
