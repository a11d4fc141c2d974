"""What a new disagreement may look like: columns of torque, sums of which the monitor fits.

Only effects that come and go while an arm is watched are here, and only those that are linear
in their parameters. What looks like one of them within two seconds is named as an ambiguity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.effects.base import FLANGE, START_ODDS, Effect
from adapter.effects.by_joint import JointSignals
from adapter.effects.catalogue import CATALOGUE
from adapter.gap.evidence import score, scores
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics import kernels
from adapter.screening.likelihood import LOAD_STD

JOINT_ODDS = -6.0  # ln of how much more rarely than a hand grips or lets go a joint changes


@dataclass(frozen=True)
class Signature:
    """One effect at one place.

    Attributes:
        effect: of the catalogue; joint: from 0, -1 at the flange.
        columns: (k,) indices of its columns.
    """

    effect: Effect
    joint: int
    columns: np.ndarray

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def std(self) -> Array:
        """(k,) of its coefficients before any data."""
        return LOAD_STD if self.effect.is_theta else np.array(self.effect.templates()[0].prior_std)

    @property
    def log_odds(self) -> float:
        """ln of how much more often it begins, while one watches, than loads and pushes do."""
        rarer = self.effect.log_odds_of_start - START_ODDS + (0.0 if self.joint < 0 else JOINT_ODDS)
        return self.effect.log_odds + rarer

    @property
    def joints(self) -> list[int]:
        """From 1; none at the flange."""
        return [] if self.joint < 0 else [self.joint + 1]

    def evidence(self, G: Array, b: Array) -> Array:
        """(s,) ln of how much better it explains than nothing, from its G (s, k, k), b (s, k)."""
        return scores(G, b, self.std)[0] + self.log_odds

    def coefficients(self, G: Array, b: Array) -> Array:
        """(k,) most likely coefficients from its G (k, k) and b (k,)."""
        return score(G, b, self.std).x

    def decode(self, x: Array) -> dict[str, Any]:
        """Coefficients (k,) as parameters of the catalogue, those that are one number."""
        if self.effect.is_theta and x[0] < 0.02:  # kg; below it a load has no centre
            return {self.effect.parameters[0].key: float(x[0])}
        values = self.effect.templates()[0].decode(x)
        return {key: value for key, value in values.items() if np.ndim(value) == 0}


class Candidates:
    """Signatures, those of equally many columns scored together: there are forty, five a second.

    Args:
        signatures: in the order that scores come in.
    """

    def __init__(self, signatures: Sequence[Signature]) -> None:
        self._odds = np.array([signature.log_odds for signature in signatures])
        sizes = np.array([len(signature.columns) for signature in signatures])
        self._alike = []
        for size in np.unique(sizes):
            same = np.flatnonzero(sizes == size)
            own = [signature for signature in signatures if len(signature.columns) == size]
            columns, std = np.array([x.columns for x in own]), np.array([x.std for x in own])
            self._alike.append((same, columns, std))

    def evidence(self, G: Array, b: Array) -> Array:
        """(c, s) `Signature.evidence` of each, from G (s, K, K) and b (s, K) of all columns."""
        found = np.empty((len(self._odds), len(b)))
        for same, columns, std in self._alike:
            own = G[:, columns[:, :, None], columns[:, None, :]], b[:, columns]
            flat = [part.reshape(-1, *part.shape[2:]) for part in own]
            one = scores(flat[0], flat[1], np.tile(std, (len(b), 1)))[0]
            found[same] = one.reshape(len(b), -1).T
        return found + self._odds[:, None]


def watched() -> tuple[list[Effect], list[Effect]]:
    """Effects that may begin while one watches: those of joints, those of the flange."""
    both = [effect for effect in CATALOGUE.values() if effect.watched]
    return [e for e in both if e.scope != FLANGE], [e for e in both if e.scope == FLANGE]


def candidates(n: int) -> tuple[Signature, ...]:
    """All of them for an arm of n joints, in the order of `LearnedFrames.signatures`."""
    found, at = [], 0
    at_joints, at_flange = watched()
    for effect in at_joints:
        size = len(effect.templates()[0].prior_std)
        rows = at + n * np.arange(size)
        found += [Signature(effect, j, rows + j) for j in range(n)]
        at += n * size
    for effect in at_flange:
        size = len(effect.templates()[0].prior_std)
        found.append(Signature(effect, -1, np.arange(at, at + size)))
        at += size
    return tuple(found)


class LearnedFrames:
    """The learned frames, and all columns of torque on them.

    Args:
        tree: N and A; R0, p: placements, copied.
        base: (12,) motion of the base.
        smoothing_s: how long the filter takes a step of torque.
    """

    def __init__(self, tree: Tree, R0: Array, p: Array, base: Array, smoothing_s: float) -> None:
        self.n = tree.n
        self.R0, self.p, self._base = R0.copy(), p.copy(), base
        self._frames = kernels.placed(tree, self.R0, self.p)
        self._smoothing_s = smoothing_s

    def regressor(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y (m, n, 10 n)."""
        Y = np.empty((*q.shape, 10 * self.n))
        joints = kernels.JointMotion(q, dq, ddq)
        kernels.regressors(self._frames, joints, self._base[None], Y)
        return Y

    def signatures(self, q: Array, dq: Array, ddq: Array, tau: Array, Y: Array) -> Array:
        """(m, n, K) torque per unit of each coefficient; tau (m, n) is the model's, Y its own."""
        joints, parts = np.arange(self.n), []
        at = JointSignals(q, dq, ddq, tau, self._smoothing_s)
        at_joints, at_flange = watched()
        for effect in at_joints:
            for column in effect.columns(at):
                table = np.zeros((*q.shape, self.n))
                table[:, joints, joints] = column
                parts.append(table)
        for effect in at_flange:
            if effect.is_theta:
                parts.append(Y[:, :, -10:])
            else:
                pushes = np.empty((*q.shape, 6))
                kernels.wrench_torques(self._frames, q, -np.eye(6), pushes)
                parts.append(pushes)
        return np.concatenate(parts, axis=2)
