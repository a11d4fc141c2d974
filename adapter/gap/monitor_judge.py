"""Whether the last seconds show something new, what it is called, and whether it is over."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from adapter.effects.catalogue import CATALOGUE
from adapter.gap.monitor_evidence import ROWS_PER_GROUP, Belief, Evidence, Level, RowGroup
from adapter.gap.monitor_signatures import Candidates, Signature, candidates
from adapter.gap.phrases import measured
from adapter.gap.result import UNEXPLAINED
from adapter.model.spatial import Array

GROUPS = 10  # in the window, 0.2 s each
LATEST_S = 1.4  # after its start the best name is told even if another is close
OVER_THRESHOLD = 10.0
OVER_SHARE = 0.7  # of the best new name's evidence, which has more freedom around the edge
EDGE_ROWS, HALF_ROW_S = 3, 0.02
LEFT_RATIO, LEFT_SHARE = 4.0, 0.15  # of the level, of the residual: more is left unexplained
POWER, POWER_OVER, POWER_S = 6.0, 2.0, 1.0  # times the level over a second: something, nothing


class DisagreementDetector:
    """Judges one window after the other.

    Args:
        n: joints.
        belief: from before the window; level: of the noise; book: takes the reports.
    """

    def __init__(self, n: int, belief: Belief, level: Level, found: DisagreementList) -> None:
        self._candidates = candidates(n)
        self._all = Candidates(self._candidates)
        self._belief, self._level, self._found = belief, level, found
        self._groups: Sequence[RowGroup] = ()
        self._judged, self._now_s = GROUPS, 0.0
        self._quiet_until_s, self._began_s = -np.inf, np.inf

    def judge(self, groups: Sequence[RowGroup], now_s: float) -> None:
        """Look at a window: what is over, what is new."""
        self._groups, self._now_s = groups, now_s
        self._judged += 1
        before = len(self._found.reports)
        evidence = self._evidence()
        G, b = evidence.information(ROWS_PER_GROUP)
        scores = self._all.evidence(G, b)
        left = evidence.residual - evidence.rows.Z @ evidence.shift
        left *= np.sqrt(self._level.share(evidence.rows.doubt))
        each = np.reshape(left[-25:] ** 2, (-1, ROWS_PER_GROUP, left.shape[1])).mean(axis=1)
        power = np.median(each, axis=0) / self._level.row  # most of a second, not one jump in it
        ended = False
        for found in self._found.active:
            over_s = self._end_of(found, evidence, scores, power) if found.lasts else None
            if over_s is not None:  # something reported acts no more
                self._found.close(found, over_s)
                ended = True
                break
        ready = self._judged >= 30 and now_s >= self._quiet_until_s  # the window has filled
        if not ended and ready and len(self._found.active) < 6:  # disagreements at a time
            self._report_something(evidence, scores, power)
        if ended or len(self._found.reports) > before:
            self._quiet_until_s, self._began_s = now_s + 0.9, np.inf  # s to the next report
        self._found.refresh(self._belief, evidence)

    def _evidence(self, weight: Array | None = None) -> Evidence:
        rows = RowGroup.joined(self._groups)
        if weight is None:
            weight = self._found.weights(rows.t, self._level.weight(rows.doubt))
        return Evidence(replace(rows, Z=self._found.columns(rows)), weight, self._belief)

    def _end_of(
        self, found: Disagreement, evidence: Evidence, scores: Array, power: Array
    ) -> float | None:
        """When something ended; None while it lasts."""
        if found.candidate is None:
            old = self._now_s - found.since_s > 2.0 * POWER_S
            quiet = old and bool((power[found.joints] < POWER_OVER).all())
            return self._now_s - POWER_S if quiet else None
        own = scores[self._candidates.index(found.candidate)]
        if own.max() < OVER_THRESHOLD:  # an end looks like the same with the other sign
            return None
        first, t = int(np.argmax(own)) * ROWS_PER_GROUP, evidence.rows.t
        ends = t[max(first - ROWS_PER_GROUP, 0) : first + ROWS_PER_GROUP : 2]
        gains = [self._gain_of_end(found, float(end), evidence) for end in ends]
        if max(gains) > max(OVER_THRESHOLD, OVER_SHARE * float(scores.max())):
            return float(ends[int(np.argmax(gains))])
        return None

    def _gain_of_end(self, found: Disagreement, end_s: float, evidence: Evidence) -> float:
        """How much better the window is explained if something ended then."""
        if end_s <= found.since_s + EDGE_S:
            return -np.inf
        found.over_s = end_s
        ended = self._evidence(evidence.weight)
        found.over_s = np.inf
        return ended.total - evidence.total

    def _report_something(self, evidence: Evidence, scores: Array, power: Array) -> None:
        """Tell the best candidate if it leads, or that nothing explains what is new."""
        best = scores.max(axis=1)
        which = int(np.argmax(best))
        if best[which] <= 12.0:  # log evidence of a report
            self._began_s = np.inf  # but that no candidate looks like may be there for a second
            known = {j for found in self._found.active for j in found.joints if found.lasts}
            loud = np.flatnonzero(power > POWER)
            joints = [int(j) for j in loud if int(j) not in known]
            if joints:
                score = float(np.sqrt(power[joints].max()))
                self._found.unexplained(joints, self._now_s - POWER_S, self._now_s, score)
            return
        candidate, t = self._candidates[which], evidence.rows.t
        G, b = evidence.information(1, candidate.columns)
        fine = candidate.evidence(G, b)
        first = int(np.argmax(fine))
        if fine[first] - fine[0] < 4.0:  # it may have been there all along: nothing new
            return
        self._began_s = min(self._began_s, float(t[first]))
        if self._now_s - self._began_s >= LATEST_S:  # the start may wander; then the first counts
            first = min(first, int(np.searchsorted(t, self._began_s)))
        age_s = self._now_s - float(t[first])
        if age_s >= 0.7:  # after its start: before, all names look alike
            self._name(evidence, first, float(np.sqrt(2.0 * best[which])), age_s < LATEST_S)

    def _name(self, evidence: Evidence, first: int, score: float, may_wait: bool) -> None:
        """Tell what began at row `first`, unless it may wait and two names are close."""
        t, weight = evidence.rows.t, evidence.weight.copy()
        since_s = float(t[first]) - HALF_ROW_S
        weight[np.abs(t - since_s) < EDGE_S] = 0.0
        clear = self._evidence(weight)
        G, b = clear.information(len(clear.rows.S) - first, first=first)
        best = self._all.evidence(G, b)[:, 0]
        order = np.argsort(-best)
        which = int(order[0])
        close = [self._candidates[k] for k in order[1:4] if best[k] > best[which] - 3.0]  # nats
        if close and may_wait:
            return
        candidate = self._candidates[which]
        own = candidate.columns
        a = candidate.coefficients(G[0][np.ix_(own, own)], b[0, own])
        joints = self._left(clear, candidate, a, first)
        if joints:
            self._found.unexplained(joints, since_s, self._now_s, score)
            return
        told = Report(candidate, since_s, self._now_s, score, candidate.decode(a), close)
        self._found.name(self._belief, told)

    def _left(self, evidence: Evidence, candidate: Signature, a: Array, first: int) -> list[int]:
        """Joints (from 0) where much of the residual stays when the candidate is in."""
        late = slice(first + EDGE_ROWS, None)
        share = self._level.share(evidence.rows.doubt)[late]
        left = share * evidence.leftover(candidate, a, first)[late] ** 2
        if len(left) < ROWS_PER_GROUP:
            return []
        whole = np.sum(share * evidence.residual[late] ** 2, axis=0)
        much = np.mean(left, axis=0) > LEFT_RATIO * self._level.row
        much &= left.sum(axis=0) > LEFT_SHARE * whole
        return [int(j) for j in np.flatnonzero(much & (evidence.weight[-1] > 0.0))]


SAME_S, WIDER = 0.5, 3.0  # of one thing that is larger than its prior: told since; times that prior
EDGE_S = 0.1  # around starts and ends, where the filter is between two states


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

    candidate: Signature | None
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


class Report(NamedTuple):
    """An effect that is to be told: since when, seen when, how sure, its size, and its rivals."""

    candidate: Signature
    since_s: float
    now_s: float
    score: float
    size: Mapping[str, Any]
    close: Sequence[Signature]


class DisagreementList:
    """All disagreements of a run.

    Args:
        say: takes a sentence when something is reported, and when it is over.

    Attributes:
        reports: every entry ever made.
        active: those that last, and those that ended within the window.
        start_s: stamp that the sentences' times count from.
    """

    def __init__(self, say: Callable[[str], None] | None = None) -> None:
        self.reports: list[dict[str, Any]] = []
        self.active: list[Disagreement] = []
        self.start_s = 0.0
        self._say = say or (lambda line: None)

    def name(self, belief: Belief, told: Report) -> None:
        """Report an effect; the belief gets its coefficients.

        What began in one place when something was reported there is that, larger than believed.
        """
        candidate = told.candidate
        for found in self.active:
            there = found.candidate
            at_once = found.lasts and abs(found.since_s - told.since_s) < SAME_S
            if there is not None and there.joint == candidate.joint and at_once:
                wider = np.zeros(len(belief.rhs))
                wider[found.at : found.at + len(there.std)] = np.square(WIDER * there.std)
                belief.widen(wider)
                return
        entry = self._entry(candidate.name, candidate.joints, told.since_s, told.now_s, told.score)
        entry["size"] = dict(told.size)
        entry["ambiguous_with"] = [{"what": c.name, "joints": c.joints} for c in told.close]
        self.active.append(Disagreement(candidate, entry, told.since_s, at=len(belief.rhs)))
        belief.extend(candidate.std)
        self._say(sentence(entry, self.start_s))

    def unexplained(self, joints: list[int], since_s: float, now_s: float, score: float) -> None:
        """Report that nothing explains what is new on these joints (from 0)."""
        entry = self._entry(UNEXPLAINED, [j + 1 for j in joints], since_s, now_s, score)
        self.active.append(Disagreement(None, entry, since_s, joints=joints))
        self._say(sentence(entry, self.start_s))

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
        self._say(sentence(found.entry, self.start_s))

    def columns(self, rows: RowGroup) -> Array:
        """(r, n, D) the rows' Z with the columns of what was reported, where it acts."""
        parts = [rows.Z]
        for found in self.active:
            if found.candidate is not None:
                on = found.on(rows.t)[:, None, None]
                parts.append(rows.S[:, :, found.candidate.columns] * on)
        return np.concatenate(parts, axis=2) if len(parts) > 1 else rows.Z

    def weights(self, t: Array, weight: Array) -> Array:
        """(m, n); next to nothing for joints that nothing explains, nothing around the edges."""
        weight = weight.copy()
        for found in self.active:
            if found.candidate is None:
                weight[:, found.joints] *= 1e-3  # weight of a joint with something unexplained
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


def sentence(report: Mapping[str, Any], start_s: float) -> str:
    """One line on a report, for people; times count from the stamp `start_s`."""
    where = f" on joint {', '.join(map(str, report['joints']))}" if report["joints"] else ""
    effect = CATALOGUE.get(report["what"])
    units = {p.key: p.unit for p in effect.parameters} if effect else {}
    sizes = report["size"].items()
    size = ", ".join(f"{key} {measured(x, None, units[key])}" for key, x in sizes)
    over = "" if report["over_s"] is None else f", over at {report['over_s'] - start_s:.2f} s"
    also = " or ".join(other["what"] for other in report["ambiguous_with"])
    what = report["what"] + (f" (or {also})" if also else "")
    line = f"{what.replace('_', ' ')}{where} since {report['since_s'] - start_s:.2f} s{over}"
    return f"{line}{': ' + size if size else ''} (seen at {report['reported_s'] - start_s:.2f} s)"
