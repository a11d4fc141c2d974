"""Which file, column and unit holds which signal, and what these say, in SI and of one shape."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adapter.signals.source_table import SourceTable, read_npz, read_parquet, read_table
from drivers.errors import choices
from drivers.files.mcap import Commands
from drivers.interface import Array, DriverError

SLIDING_UNITS = "m", "mm", "N"  # units of joints that do
_PLACES = {"rad": 1.0, "deg": np.pi / 180, "m": 1.0, "mm": 1e-3}
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "q": _PLACES,
    "dq": _PLACES,
    "tau": {"Nm": 1.0, "mNm": 1e-3, "N": 1.0},
    "cmd": _PLACES,
}
SIGNALS = tuple(UNITS)
ALL = ""  # the source of every signal that has none of its own
_TOLD = {  # words of a header that name a signal, and beginnings of such
    "time": ({"t"}, ("time", "zeit", "stamp")),
    "q": ({"q", "pos"}, ("posit", "winkel", "gelenkwinkel", "angle", "istposit")),
    "dq": ({"dq", "qd", "vel"}, ("veloc", "geschw", "speed", "drehz")),
    "tau": ({"tau", "trq"}, ("torque", "moment", "drehmom", "effort")),
    "cmd": (
        {"cmd", "ref", "des"},
        ("command", "action", "soll", "target", "goal", "desired", "setpoint"),
    ),
}
_LEROBOT = {"q": "observation.state", "cmd": "action"}  # before all others
_OTHERS = {"x", "y", "z", "tcp", "error", "fehler", "min", "max", "limit", "limits"}
_SPELLED = {  # units as headers have them
    **dict.fromkeys(("sec", "second", "seconds", "sek", "sekunden"), "s"),
    "msec": "ms",
    **dict.fromkeys(("usec", "µs", "μs"), "us"),
    "nsec": "ns",
    **dict.fromkeys(("°", "º", "degree", "degrees", "grad"), "deg"),
    **dict.fromkeys(("radian", "radians", "1"), "rad"),
    **dict.fromkeys(("n·m", "n*m", "n m", "n.m"), "Nm"),
}
_MOST = {"time": 9e9, "q": 1e4, "dq": 1e6, "tau": 1e6, "cmd": 1e4}  # SI; beyond, it is another one
_WHAT = {"time": "time", "q": "angle", "dq": "velocity", "tau": "torque", "cmd": "angle"}


@dataclass(frozen=True)
class ImportSpec:
    """Where each signal is, and in which unit.

    Attributes:
        sources: a file for each signal (time, q, dq, tau, and cmd: commanded positions), "" for
            those without their own. Text tables (packed by gzip or not), .npz, .parquet, the
            folder of a LeRobot data set, or one of SAGE with its `control.csv`.
        columns: selectors of each signal in its file (`SourceTable.places`), or the key
            in an .npz. Where absent: the usual names, or the whole of a signal's own file.
        units: time s, ms, us, ns; q rad, deg, m, mm; dq (per second) and cmd likewise, that of q
            where absent; tau Nm, mNm, N. Headers may say another one for each column.
        joint_names: those wanted. Where the source tells no names they are those of its columns;
            joint1, joint2, ... where empty.
        names: joints of the source and what they are called; `left_*` to `*` takes off a prefix.
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
    names: Mapping[str, str] = field(default_factory=dict)
    flat: bool = False
    period_s: float | None = None
    overwrite: bool = False
    episode: int | None = None
    topic: str | None = None

    @classmethod
    def from_options(
        cls,
        sources: Sequence[str],
        columns: str = "",
        units: str = "",
        names: Sequence[str] = (),
        **other: Any,
    ) -> ImportSpec:
        """From a command line.

        Args:
            sources: `FILE`, or `SIGNAL=FILE` for each signal.
            columns: `time=0,q=1:8,dq=8:15,tau=tau1,tau2,...`.
            units: `q=deg,tau=mNm,time=ms`.
            names: `SOURCE=NAME` for each joint that is called otherwise in the source.
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
        pairs: dict[str, str] = {}
        for text in names:
            told, _, name = text.partition("=")
            if not told or not name or told.count("*") != name.count("*") or "*" in told[:-1]:
                raise DriverError(f"--names {text}: is not SOURCE=NAME, or PREFIX*=*")
            pairs[told] = name
        return cls(files, _assignments(columns, "column"), chosen, names=pairs, **other)


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
    usual = units.get("q", "rad") if signal in ("dq", "cmd") else next(iter(UNITS[signal]))
    unit = units.get(signal, usual)
    if unit not in UNITS[signal]:
        raise DriverError(f"no unit '{unit}' for {signal}; {choices(unit, UNITS[signal])}")
    return UNITS[signal][unit]


def refuse_wild(where: str, place: Callable[[int], str], signal: str, values: Array) -> None:
    """Refuse numbers that no arm has.

    Args:
        where: the file; place: what stands at a row of it, in words.
        signal: time, q, dq, tau or cmd; values: (m, k), SI.

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


def _words(name: str) -> set[str]:
    """Words of a header without its unit, and those of one like JointPos1."""
    name = re.split(r"[\[(]", name)[0]
    words = re.findall(r"[^\W\d_]+", name) + re.findall("[A-Z][a-z]{2,}", name)
    return {word.casefold() for word in words}


def _named(signal: str, names: Sequence[str]) -> tuple[list[int], bool]:
    """Places of the headers that name a signal and no other one (q_cmd is a command).

    Of those that say nothing else (q1), where there are such; and whether there are.
    """
    found = {}
    for i, words in enumerate(map(_words, names)):
        starts = {s: any(x.startswith(begins) for x in words) for s, (_, begins) in _TOLD.items()}
        told = {s for s, (whole, _) in _TOLD.items() if words & whole or starts[s]}
        if not words & _OTHERS and told - ({"q"} if signal == "cmd" else set()) == {signal}:
            found[i] = len(words) == 1
    alone = [i for i, is_alone in found.items() if is_alone]
    return alone or list(found), bool(alone)


class SourceReader:
    """Finds signals in files; each file is read once.

    Attributes:
        units: those that the specification says, and those that headers do.
        joint_names: of the columns, as many as there should be; () where nobody says.
        said: what was found out, a sentence each.
        called: by signal, what selects its columns where nobody named them.
    """

    def __init__(self, spec: ImportSpec, joint_names: tuple[str, ...] = ()) -> None:
        asked = (*spec.sources, *spec.columns, *spec.units)
        unknown = [s for s in asked if s not in SIGNALS and s != ALL]
        if unknown:
            raise DriverError(f"no signal '{unknown[0]}'; {choices(unknown[0], SIGNALS)}")
        self._spec = spec
        self._tables: dict[Path, SourceTable] = {}
        self._arrays: dict[Path, dict[str, Array]] = {}
        self.units, self.joint_names = dict(spec.units), joint_names
        self.said: list[str] = []
        self._of_q: Array = np.zeros(0)  # from the units of its columns to SI
        self.called: dict[str, str] = {}

    def source(self, signal: str) -> Path | None:
        """The file of a signal."""
        path = self._spec.sources.get(signal, self._spec.sources.get(ALL))
        return None if path is None else Path(path)

    def is_asked(self, signal: str) -> bool:
        """Whether the specification says where a signal is."""
        return signal in self._spec.sources or signal in self._spec.columns

    def read(self, signal: str, beside: str | None = None) -> Array | None:
        """(m, k) values in SI units; None where the signal isn't there and wasn't asked for.

        Args:
            beside: a signal in whose file it is looked for, under its usual names.
        """
        path = self.source(beside or signal)
        if path is None:
            return None
        told = beside is None and signal in self._spec.columns
        find = self._in_arrays if path.suffix == ".npz" else self._in_table
        values = find(path, signal, told)
        if values is None:
            return None
        table = self._tables.get(path)
        refuse_wild(str(path), table.place if table else "row {}".format, signal, values)
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
            table.numbers(_named(signal, table.names)[0])  # a text is the reason
            having = f"its columns: {', '.join(table.names) or f'0 to {len(table) - 1}'}"
        more = " or, of an arm that tells none, its commands, cmd=..." if signal == "tau" else ""
        raise DriverError(
            f"{path}: which column is {signal}? Name it, {signal}=...{more}; {having}"
        )

    def _in_table(self, path: Path, signal: str, told: bool) -> Array | None:
        """The columns of a signal; `told`: where the specification says."""
        if path not in self._tables:
            packed = path.suffix == ".parquet" or path.is_dir()
            self._tables[path] = (
                read_parquet(path, self._spec.episode) if packed else read_table(path)
            )
        table = self._tables[path]
        if told or (signal in self._spec.columns and not table.names):
            places = table.places(self._spec.columns[signal], signal)
        else:
            places = self._usual(table, signal)
            if not places and Path(self._spec.sources.get(signal, "")) == path:
                times = self._usual(table, "time") if len(table) > 1 else []
                rest = [i for i in range(len(table)) if i not in times]
                places = [i for i in rest if not table.is_text(i)] or rest
        if not places:
            return None
        values = table.numbers(places, blanks=signal == "cmd")
        with np.errstate(over="ignore"):
            return values * self._factors(table, places, signal)

    def _usual(self, table: SourceTable, signal: str) -> list[int]:
        """Places of the columns whose header names a signal."""
        places, known = table.found(_LEROBOT[signal]) if signal in _LEROBOT else [], True
        if not places:
            places, known = _named(signal, table.names)
        places = [i for i in places if not table.is_text(i)][: 1 if signal == "time" else None]
        told = {i: re.findall(r"\d+", re.split(r"[\[(]", table.names[i])[0]) for i in places}
        if len({*map(tuple, told.values())}) == len(told) == sum(map(len, told.values())):
            places = sorted(told, key=lambda i: [int(x) for x in told[i]])  # J7 to J1 are 1 to 7
        names = dict.fromkeys(re.sub(r"\[\d+\]$", "", table.names[i]) for i in places)
        self.called[signal] = ",".join(names)
        if names and not known:
            self._say(f"{table.path}: {signal} is taken to be {self.called[signal]}")
        return places

    def _say(self, sentence: str) -> None:
        if sentence not in self.said:
            self.said.append(sentence)

    def _factors(self, table: SourceTable, places: list[int], signal: str) -> Array:
        """(k,) from the units of columns to SI."""
        known = {x.casefold(): x for x in UNITS[signal]} | _SPELLED
        factors = np.full(len(places), unit_factor(self.units, signal))
        follows = signal in ("dq", "cmd") and signal not in self._spec.units
        if follows and len(self._of_q) == len(places):
            factors = self._of_q.copy()
        for k, i in enumerate(places if table.units and signal not in self._spec.units else ()):
            word = re.sub(r"(/|\s*per\s*)s(ec)?$|·?s\^?-1$|·?s⁻¹$", "", table.units[i])
            unit = known.get(word.casefold(), "")
            if unit in UNITS[signal]:
                factors[k] = UNITS[signal][unit]
                if unit not in SLIDING_UNITS:  # those say nothing of the other columns
                    self.units.setdefault(signal, unit)
            elif word:
                usual = next(iter(UNITS[signal]))
                self._say(f"{table.path}: {signal} in [{table.units[i]}] is taken as {usual}")
        if signal == "q":
            self._of_q = factors
        return factors

    def _in_arrays(self, path: Path, signal: str, told: bool) -> Array | None:
        if path not in self._arrays:
            self._arrays[path] = read_npz(path)
        arrays = self._arrays[path]
        keys = self._spec.columns[signal] if told else None
        if keys is None:
            keys = tuple(list(arrays)[i] for i in _named(signal, list(arrays))[0][:1])
        elif len(keys) != 1 or keys[0] not in arrays:
            raise DriverError(
                f"{path}: no array '{','.join(keys)}' for {signal}; have: {', '.join(arrays)}"
            )
        if not keys:
            return None
        self.called[signal] = keys[0]
        values = arrays[keys[0]]
        if values.ndim > 2:
            raise DriverError(f"{path}: {keys[0]} has {values.ndim} dimensions, need 1 or 2")
        with np.errstate(over="ignore"):
            return values.reshape(len(values), -1) * unit_factor(self.units, signal)


def read_signals(
    reader: SourceReader, spec: ImportSpec
) -> tuple[NDArray[np.int64], Array, Array | None, Array | None, Commands | None]:
    """Stamps (m,) ns, q, dq, tau (m, n) in SI units and commands, checked against one another.

    Raises:
        DriverError: one that is needed is not there, or has another number of rows or columns.
    """
    times = reader.read("time")
    if times is None and spec.period_s is None:
        reader.need("time")
    q, dq, asked = reader.need("q"), reader.read("dq"), reader.read("cmd")
    tau = reader.need("tau") if asked is None else reader.read("tau")
    if times is not None and times.shape[1] != 1:
        raise DriverError(f"{reader.source('time')}: time has {times.shape[1]} columns, need 1")
    samples = len(q) if times is None else len(times)
    if times is None and spec.flat:
        if not reader.joint_names:
            said = "how many values make a sample? Name the joints, or a time file"
            raise DriverError(f"{reader.source('q')}: {said}")
        samples = q.size // len(reader.joint_names)
    seconds = np.arange(samples) * (spec.period_s or 0.0) if times is None else times[:, 0]
    stamp_ns = _stamps(reader, "time", seconds)
    q = _shape(reader, "q", q, samples)
    commands = None if asked is None else _commands(reader, asked, stamp_ns, q.shape[1])
    if commands is None and tau is None:
        reader.need("tau")
    if commands is not None and tau is not None and not reader.is_asked("tau"):
        said = f"; `gap` weighs torques (without: --columns cmd={reader.called.get('cmd')})"
        if reader.is_asked("cmd"):
            tau, keep = None, f"--columns tau={reader.called['tau']}"
            said = f", torques left out; `gap` explains the servos (with torques: {keep})"
        reader.said.append(f"{reader.source('tau')}: commands are taken{said}")
    dq = None if dq is None else _shape(reader, "dq", dq, samples, q.shape[1])
    tau = None if tau is None else _shape(reader, "tau", tau, samples, q.shape[1])
    return stamp_ns, q, dq, tau, commands


def _commands(
    reader: SourceReader, q: Array, stamp_ns: NDArray[np.int64], count: int
) -> Commands | None:
    """Commanded positions at stamps of their own where their file has such; blank rows are none."""
    path, samples = reader.source("cmd"), stamp_ns
    if not reader.is_asked("cmd") and q.shape[1] != count:
        reader.said.append(f"{path}: {q.shape[1]} columns of cmd for {count} joints; left out")
        return None
    own = reader.read("time", beside="cmd") if path != reader.source("q") else None
    if own is not None:
        stamp_ns = _stamps(reader, "cmd", own[:, 0])
    q = _shape(reader, "cmd", q, len(stamp_ns), count)
    known = np.isfinite(q).all(axis=1)
    stamp_ns, q = stamp_ns[known], q[known]
    if len(q) and not (stamp_ns[0] <= samples.max() and samples.min() <= stamp_ns[-1]):
        first, last = 1e-9 * (stamp_ns[[0, -1]] - samples[0])
        raise DriverError(
            f"{path}: commands are from {first:.6g} to {last:.6g} s after the first sample, none "
            "while the arm was recorded; are both on one clock, in one unit of time?"
        )
    return Commands(stamp_ns, np.full_like(q, np.nan), q)


def _stamps(reader: SourceReader, signal: str, seconds: NDArray[np.floating]) -> NDArray[np.int64]:
    bad = np.flatnonzero(~np.isfinite(seconds))
    if bad.size:
        raise DriverError(f"{reader.source(signal)}: the time of sample {bad[0]} is not a number")
    return np.round(seconds * 1e9).astype(np.int64)


def _shape(
    reader: SourceReader, signal: str, values: Array, samples: int, count: int | None = None
) -> Array:
    """(samples, n); a single column of n values a sample is cut into rows."""
    if len(values) != samples and values.shape[1] == 1 and samples and not values.size % samples:
        values = values.reshape(samples, -1)
    if len(values) != samples:
        raise DriverError(
            f"{reader.source(signal)}: {signal} has {len(values)} lines of {values.shape[1]} "
            f"values for {samples} samples; need as many lines, or one value a line and a whole "
            "number a sample"
        )
    names = reader.joint_names
    count = len(names) or count or values.shape[1]
    if values.shape[1] != count:
        raise DriverError(
            f"{reader.source(signal)}: {signal} has {values.shape[1]} columns for {count} joints "
            f"({', '.join(names) or 'as many as q has columns'})"
        )
    return values
