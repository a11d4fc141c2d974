"""What to import: which file, column and unit holds which signal."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.interface import DriverError

SIGNALS = ("time", "q", "dq", "tau")
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "q": {"rad": 1.0, "deg": np.pi / 180},
    "dq": {"rad": 1.0, "deg": np.pi / 180},
    "tau": {"Nm": 1.0, "mNm": 1e-3},
}
ALL = ""  # the source of every signal that has none of its own


@dataclass(frozen=True)
class ImportSpec:
    """Where each signal is, and in which unit.

    Attributes:
        sources: a file for each signal (time, q, dq, tau), "" for those without their own. Text
            tables or .npz.
        columns: selectors of each signal in its file (`adapter.tables.Table.columns`), or the key
            in an .npz. Where absent: the usual names, or the whole of a signal's own file.
        units: time s, ms, us, ns; q rad, deg; dq rad, deg (per second; that of q where absent);
            tau Nm, mNm.
        joint_names: in the order of the columns; joint1, joint2, ... where empty.
        flat: files have one value a line, sample after sample (found out where time is a file).
        period_s: of the samples, where there is no time.
        overwrite: replace an existing recording.
    """

    sources: Mapping[str, Path]
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    joint_names: tuple[str, ...] = ()
    flat: bool = False
    period_s: float | None = None
    overwrite: bool = False

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
            files[_signal(match[1]) if match else ALL] = Path(match[2] if match else source)
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
                raise DriverError(f"no signal '{name}' for a {what}; have: {', '.join(SIGNALS)}")
            current = found.setdefault(_signal(name), [])
            current.append(value)
        elif current is None:
            raise DriverError(f"{what} '{word}' belongs to no signal; write SIGNAL={word}")
        else:
            current.append(word)
    return {name: tuple(words) for name, words in found.items()}
