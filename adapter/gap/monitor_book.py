"""What the monitor has reported: entries for people and files, and their place in the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adapter.gap.monitor_evidence import Belief, Evidence
from adapter.gap.monitor_signatures import Candidate
from adapter.records import Array

UNEXPLAINED = "unexplained"
EDGE_S = 0.1  # around starts and ends, where the filter is between two states
MUTED = 1e-3  # weight of a joint with something unexplained


@dataclass(eq=False)
class Disagreement:
    """Something new.

    Attributes:
        candidate: None for what is unexplained.
        entry: what is told, see `adapter.gap.monitor.Monitor`.
        since_s, over_s: on the arm's clock.
        at: first of its coefficients in the belief, -1 where it has none.
        joints: from 0, of what is unexplained.
    """

    candidate: Candidate | None
    entry: dict[str, Any]
    since_s: float
    over_s: float = np.inf
    at: int = -1
    joints: list[int] = field(default_factory=list)

    @property
    def lasts(self) -> bool:
        """Whether its end was not seen yet."""
        return bool(self.over_s == np.inf)

    def on(self, t: Array) -> Array:
        """(m,) 1 where it acts."""
        return np.asarray((t >= self.since_s) & (t < self.over_s), dtype=float)


class Book:
    """All disagreements of a run.

    Args:
        say: takes a sentence when something is reported, and when it is over.

    Attributes:
        reports: every entry ever made.
        active: those that last, and those that ended within the window.
    """

    def __init__(self, say: Callable[[str], None] | None = None) -> None:
        self.reports: list[dict[str, Any]] = []
        self.active: list[Disagreement] = []
        self._say = say or (lambda line: None)

    def name(
        self,
        belief: Belief,
        candidate: Candidate,
        since_s: float,
        now_s: float,
        score: float,
        size: Mapping[str, Any],
        close: Sequence[Candidate],
    ) -> None:
        """Report an effect; the belief gets its coefficients."""
        entry = self._entry(candidate.name, candidate.joints, since_s, now_s, score)
        entry["size"] = dict(size)
        entry["ambiguous_with"] = [{"what": c.name, "joints": c.joints} for c in close]
        self.active.append(Disagreement(candidate, entry, since_s, at=len(belief.rhs)))
        belief.extend(candidate.std)
        self._say(sentence(entry))

    def unexplained(self, joints: list[int], since_s: float, now_s: float, score: float) -> None:
        """Report that nothing explains what is new on these joints (from 0)."""
        entry = self._entry(UNEXPLAINED, [j + 1 for j in joints], since_s, now_s, score)
        self.active.append(Disagreement(None, entry, since_s, joints=joints))
        self._say(sentence(entry))

    def _entry(
        self, what: str, joints: list[int], since_s: float, now_s: float, score: float
    ) -> dict[str, Any]:
        entry: dict[str, Any] = {
            "what": what,
            "joints": joints,
            "since_s": since_s,
            "reported_s": now_s,
            "over_s": None,
            "size": {},
            "score": score,
            "ambiguous_with": [],
        }
        self.reports.append(entry)
        return entry

    def close(self, found: Disagreement, over_s: float) -> None:
        """Something acts no more."""
        found.over_s = found.entry["over_s"] = over_s
        self._say(sentence(found.entry))

    def columns(self, t: Array, Z: Array, S: Array) -> Array:
        """Z (m, n, D0) with the columns of what was reported, where it acts."""
        parts = [Z]
        for found in self.active:
            if found.candidate is not None:
                on = found.on(t)[:, None, None]
                parts.append(S[:, :, found.candidate.columns] * on)
        return np.concatenate(parts, axis=2) if len(parts) > 1 else Z

    def weights(self, t: Array, level: Array) -> Array:
        """(m, n); next to nothing for joints that nothing explains, nothing around the edges."""
        weight = np.tile(level, (len(t), 1))
        for found in self.active:
            if found.candidate is None:
                weight[:, found.joints] *= MUTED
            for edge in (found.since_s, found.over_s):
                weight[np.abs(t - edge) < EDGE_S] = 0.0
        return weight

    def forget_before(self, t_s: float, belief: Belief) -> None:
        """What was over then needs no coefficients any more."""
        for found in [f for f in self.active if f.over_s < t_s]:
            self.active.remove(found)
            if found.candidate is None:
                continue
            size = len(found.candidate.columns)
            belief.drop(slice(found.at, found.at + size))
            for other in self.active:
                if other.at > found.at:
                    other.at -= size

    def refresh(self, belief: Belief, evidence: Evidence) -> None:
        """Sizes as the newest rows have them."""
        for found in self.active:
            if found.candidate is None or found.at >= len(evidence.shift):
                continue
            inside = slice(found.at, found.at + len(found.candidate.columns))
            a = belief.mean()[inside] + evidence.shift[inside]
            found.entry["size"] = found.candidate.decode(a)


def sentence(report: Mapping[str, Any]) -> str:
    """One line on a report, for people."""
    where = f" on joint {', '.join(map(str, report['joints']))}" if report["joints"] else ""
    size = ", ".join(f"{key} {value:.3g}" for key, value in report["size"].items())
    over = "" if report["over_s"] is None else f", over at {report['over_s']:.2f} s"
    also = " or ".join(other["what"] for other in report["ambiguous_with"])
    what = report["what"] + (f" (or {also})" if also else "")
    line = f"{what.replace('_', ' ')}{where} since {report['since_s']:.2f} s{over}"
    return f"{line}{': ' + size if size else ''} (seen at {report['reported_s']:.2f} s)"
