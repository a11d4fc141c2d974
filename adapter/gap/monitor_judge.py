"""Whether the last seconds show something new, what it is called, and whether it is over."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.gap.monitor_book import EDGE_S, Book, Disagreement
from adapter.gap.monitor_evidence import (
    Belief,
    Evidence,
    Rows,
    coefficients,
    log_evidence,
)
from adapter.gap.monitor_intake import ROWS_PER_GROUP, Group, Level
from adapter.gap.monitor_signatures import Candidate, candidates
from adapter.records import Array

GROUPS = 10  # in the window, 0.2 s each
THRESHOLD = 12.0  # log evidence of a report
MARGIN = 3.0  # log evidence by which the best name leads when it is told at once
NEW = 4.0  # log evidence for a start inside the window against one before it
SOONEST_S = 0.7  # after its start: before, all names look alike
LATEST_S = 1.4  # after its start the best name is told even if another is close
OVER_THRESHOLD = 10.0
OVER_SHARE = 0.7  # of the best new name's evidence, which has more freedom around the edge
PEAK_FACTOR = 2.0  # a report needs so many times the evidence that came and went before
PEAK_KEEP = 0.997  # of such a peak, from one group to the next: a minute
QUIET_GROUPS = 30  # after the start, while the window fills and peaks are learned
REST_S = 0.9  # after a report before the next one
EDGE_ROWS, HALF_ROW_S = 3, 0.02
LEFT_RATIO, LEFT_SHARE = 4.0, 0.15  # of the level, of the residual: more is left unexplained
POWER, POWER_OVER, POWER_S = 6.0, 2.0, 1.0  # times the level over a second: something, nothing
POWER_ROWS = 25
MOST = 6  # disagreements at a time


class Judge:
    """Judges one window after the other.

    Args:
        n: joints.
        belief: from before the window; level: of the noise; book: takes the reports.
    """

    def __init__(self, n: int, belief: Belief, level: Level, book: Book) -> None:
        self._candidates = candidates(n)
        self._belief, self._level, self._book = belief, level, book
        self._peaks, self._power_peak = np.zeros(len(self._candidates)), np.ones(n)
        self._recent: list[Array] = []
        self._powers: list[Array] = []
        self._groups: Sequence[Group] = ()
        self._judged, self._now_s = GROUPS, 0.0
        self._quiet_until_s, self._began_s = -np.inf, np.inf

    def judge(self, groups: Sequence[Group], now_s: float) -> None:
        """Look at a window: what is over, what is new."""
        self._groups, self._now_s = groups, now_s
        self._judged += 1
        before = len(self._book.reports)
        evidence = self._evidence()
        G, b = evidence.information(ROWS_PER_GROUP)
        scores = np.array(
            [log_evidence(c, _block(G, c.columns), b[:, c.columns]) for c in self._candidates]
        )
        left = evidence.residual - evidence.rows.Z @ evidence.shift
        power = np.mean(left[-POWER_ROWS:] ** 2, axis=0) / self._level.row
        ended = self._end_something(evidence, scores, power)
        ready = self._judged >= QUIET_GROUPS and now_s >= self._quiet_until_s
        if not ended and ready and len(self._book.active) < MOST:
            self._report_something(evidence, scores, power)
        self._remember(scores.max(axis=1), power)
        if ended or len(self._book.reports) > before:
            self._rest()
        self._book.refresh(self._belief, evidence)

    def _rest(self) -> None:
        """What led to a report was no burst that passed; what follows it has to wait."""
        self._quiet_until_s, self._began_s = self._now_s + REST_S, np.inf
        self._recent = [np.zeros_like(x) for x in self._recent]
        self._powers = [np.ones_like(x) for x in self._powers]

    def _evidence(self, weight: Array | None = None) -> Evidence:
        t, Z, S, tau = (
            np.concatenate([getattr(g, key) for g in self._groups])
            for key in ("t", "Z", "S", "tau")
        )
        if weight is None:
            weight = self._book.weights(t, self._level.weight)
        return Evidence(Rows(t, self._book.columns(t, Z, S), S, tau, weight), self._belief)

    def _end_something(self, evidence: Evidence, scores: Array, power: Array) -> bool:
        """Notice that something reported acts no more."""
        for found in self._book.active:
            if not found.lasts:
                continue
            over_s = self._end_of(found, evidence, scores, power)
            if over_s is not None:
                self._book.close(found, over_s)
                return True
        return False

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
        ended = self._evidence(evidence.rows.weight)
        found.over_s = np.inf
        return ended.total - evidence.total

    def _report_something(self, evidence: Evidence, scores: Array, power: Array) -> None:
        """Tell the best candidate if it leads, or that nothing explains what is new."""
        best = scores.max(axis=1)
        bar = np.maximum(THRESHOLD, PEAK_FACTOR * self._peaks)
        which = int(np.argmax(np.where(best > bar, best, -np.inf)))
        if best[which] <= bar[which]:
            self._began_s = np.inf
            self._report_power(power)
            return
        candidate, t = self._candidates[which], evidence.rows.t
        G, b = evidence.information(1, candidate.columns)
        fine = log_evidence(candidate, G, b)
        first = int(np.argmax(fine))
        if fine[first] - fine[0] < NEW:  # it may have been there all along: nothing new
            return
        self._began_s = min(self._began_s, float(t[first]))
        if self._now_s - self._began_s >= LATEST_S:  # the start may wander; then the first counts
            first = min(first, int(np.searchsorted(t, self._began_s)))
        age_s = self._now_s - float(t[first])
        if age_s >= SOONEST_S:
            self._name(evidence, first, float(np.sqrt(2.0 * best[which])), age_s < LATEST_S)

    def _name(self, evidence: Evidence, first: int, score: float, may_wait: bool) -> None:
        """Tell what began at row `first`, unless it may wait and two names are close."""
        t, weight = evidence.rows.t, evidence.rows.weight.copy()
        since_s = float(t[first]) - HALF_ROW_S
        weight[np.abs(t - since_s) < EDGE_S] = 0.0
        clear = self._evidence(weight)
        G, b = clear.from_row(first)
        fits = [(_block(G[None], c.columns), b[None, c.columns]) for c in self._candidates]
        best = np.array(
            [log_evidence(c, *fit)[0] for c, fit in zip(self._candidates, fits, strict=True)]
        )
        order = np.argsort(-best)
        which = int(order[0])
        close = [self._candidates[k] for k in order[1:4] if best[k] > best[which] - MARGIN]
        if close and may_wait:
            return
        candidate = self._candidates[which]
        a = coefficients(candidate, fits[which][0][0], fits[which][1][0])
        joints = self._left(clear, candidate, a, first)
        if joints:
            self._book.unexplained(joints, since_s, self._now_s, score)
            return
        size = candidate.decode(a)
        self._book.name(self._belief, candidate, since_s, self._now_s, score, size, close)

    def _left(self, evidence: Evidence, candidate: Candidate, a: Array, first: int) -> list[int]:
        """Joints (from 0) where much of the residual stays when the candidate is in."""
        late = slice(first + EDGE_ROWS, None)
        left = evidence.leftover(candidate, a, first)[late] ** 2
        if len(left) < ROWS_PER_GROUP:
            return []
        whole = np.sum(evidence.residual[late] ** 2, axis=0)
        much = np.mean(left, axis=0) > LEFT_RATIO * self._level.row
        much &= left.sum(axis=0) > LEFT_SHARE * whole
        return [int(j) for j in np.flatnonzero(much & (evidence.rows.weight[-1] > 0.0))]

    def _report_power(self, power: Array) -> None:
        """Something that no candidate looks like, but that is there for a second."""
        known = {j for found in self._book.active for j in found.joints if found.lasts}
        loud = np.flatnonzero(power > np.maximum(POWER, PEAK_FACTOR * self._power_peak))
        joints = [int(j) for j in loud if int(j) not in known]
        if joints:
            score = float(np.sqrt(power[joints].max()))
            self._book.unexplained(joints, self._now_s - POWER_S, self._now_s, score)

    def _remember(self, best: Array, power: Array) -> None:
        """Evidence that left the window without a report raises the bar; it fades in a minute."""
        quiet = not self._book.active and self._now_s > self._quiet_until_s
        self._recent.append(best if quiet else np.zeros_like(best))
        self._powers.append(power if quiet else np.ones_like(power))
        self._peaks *= PEAK_KEEP
        self._power_peak = np.maximum(PEAK_KEEP * self._power_peak, 1.0)
        if len(self._recent) > GROUPS:
            self._peaks = np.maximum(self._peaks, self._recent.pop(0))
            self._power_peak = np.maximum(self._power_peak, self._powers.pop(0))


def _block(G: Array, columns: np.ndarray) -> Array:
    return np.asarray(G[:, columns[:, None], columns])
