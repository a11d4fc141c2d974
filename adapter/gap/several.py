"""Several recordings of one arm: what each hand carries, and which recordings contradict the rest.

Inertias, friction, offsets and motor inertia are common to all recordings, the load is each one's
own; all are fitted in one least squares. Errors of the model that all recordings share cancel
between them, so that loads compare far better than each is known by itself.

Each recording's own coefficients are eliminated from its own products; what is left of these is
about the common ones alone and adds up (a Schur complement, recording by recording). So the work
grows with the number of recordings, and not with its square.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from adapter.effects.active import SHOWN_STD
from adapter.effects.catalogue import HELD
from adapter.gap.evidence import Carried, Noise
from adapter.gap.fit import BLOCK, Fit, place_of
from adapter.gap.load import HandLoad, load_of
from adapter.gap.real_arm import fitting_way, with_a_load
from adapter.gap.result import Finding, GapResult, LogLoad
from adapter.model.inertia import six_from_tensor
from adapter.model.self_model import FixedFrame
from adapter.model.spatial import Array

LINK_STD = (5.0, *[0.5] * 3, *[0.15] * 6)  # of what a link may differ by: kg, kg m, kg m2
FRICTION, OFFSET, LINK = "friction", "offset", "link"
NOISE, OTHERS = 4.5, 2.5  # of the noise, and of the largest among all others: more is another arm


class Difference(NamedTuple):
    """One recording's correction of something that is common to all.

    Attributes:
        size: in units of the noise; chi2: what it explains.
        recording: place of it; kind: of the difference; what: differs, for people.
    """

    size: float
    chi2: float
    recording: int
    kind: str
    what: str


@dataclass(frozen=True, eq=False)
class Several:
    """Recordings fitted together.

    Attributes:
        names: of them; frame: in whose axes loads are told.
        fits: one a recording, its load named first, at the common solution.
        together: their least squares.
    """

    names: tuple[str, ...]
    frame: FixedFrame
    fits: tuple[Fit, ...]
    together: Together

    @classmethod
    def of(cls, nominal: Fit, names: Sequence[str], frame: FixedFrame) -> Several:
        """Fit the load of every recording with all that is common.

        Args:
            nominal: the documented arm on all recordings, which are called `names`.
            frame: in whose axes loads are told.
        """
        # each alone, with a load, and all that may be beside it
        whole, named = nominal.model, with_a_load(nominal)
        models = [replace(whole, recordings=(x,), named=named) for x in nominal.recordings]
        fits = [replace(nominal, model=x, noise=(), doubts=()) for x in models]
        for first in (True, False):
            # one arm's noise: its own would hide by how much a recording is of another
            own = [fit.own_noise()[0] for fit in fits]
            level, memory = np.median([(x.level, x.memory) for x in own], axis=0)
            fits = [fit.with_noise([Noise(level, memory)]) for fit in fits]
            # a recording's own is all between the timing and the end of its load
            places = [np.arange(f.dtheta.size + 1, place_of(f, 0)[-1] + 1) for f in fits]
            parts = [Part.of(fit, place) for fit, place in zip(fits, places, strict=True)]
            together = Together(parts, parts[0].known.prior_std[parts[0].common])
            fits = [fit.at(x.all_at(together.x)) for fit, x in zip(fits, parts, strict=True)]
            if first:
                fits = [fit.instead(0, fitting_way(fit, fit.named[0])) for fit in fits]
        return cls(tuple(names), frame, tuple(fits), together)

    @cached_property
    def own(self) -> tuple[tuple[Array, Array], ...]:
        """Ten parameters (10,) of each load and their covariance (10, 10)."""
        found = (self.together.own(i) for i in range(len(self.fits)))
        turn = self.fits[0].named[0].candidate.theta
        return tuple((x[-10:] @ turn, turn.T @ C[-10:, -10:] @ turn) for x, C in found)

    @cached_property
    def loads(self) -> tuple[HandLoad, ...]:
        """What the hand carries in each recording."""
        return tuple(load_of(*own, self.frame) for own in self.own)

    @cached_property
    def odd(self) -> list[Difference]:
        """Recordings that are not of the arm of the others, the worst first."""
        return contradictions(self.fits[0], self.together)

    @cached_property
    def same_load(self) -> bool:
        """Whether all show one and the same load, within three standard deviations."""
        mass = np.array([load.mass for load in self.loads])
        std = np.empty(len(mass))
        for i, (part, (_, scores)) in enumerate(
            zip(self.together.parts, self.together.scores, strict=True)
        ):  # beside the others': without what is common
            off = scores @ part.free[:, -10]
            std[i] = np.sqrt(max(part.free[-10, -10], float(off @ off)))
        off = mass - np.average(mass, weights=std**-2.0)
        there = all(load.is_there for load in self.loads)
        return there and bool((np.abs(off) < SHOWN_STD * std).all())

    def started(self, fit: Fit) -> Fit:
        """A fit on the same recordings with the loads shown; one load where all are the same."""
        if self.same_load:
            return fit.with_named([replace(self.fits[0].named[0], recording=None)])
        loads = [
            replace(own.named[0], recording=i)
            for i, (own, load) in enumerate(zip(self.fits, self.loads, strict=True))
            if load.is_there
        ]
        return fit.with_named(loads)

    def told(self, result: GapResult) -> GapResult:
        """A result with what each recording carries, and with recordings that contradict."""
        rows = tuple(map(_row, self.names, self.loads))
        said = tuple(
            f"{self.names[x.recording]} contradicts the other recordings: {x.what} differs by more "
            "than recordings of one arm do; fit it alone"
            for x in self.odd
        )
        result = replace(result, loads=rows, contradictions=said)
        if self.same_load:
            return result
        kept = [f for f in result.findings if f.effect != HELD.name or not f.throughout]
        found = [self._finding(i) for i, load in enumerate(self.loads) if load.is_there]
        return replace(result, findings=(*found, *kept))

    def _finding(self, i: int) -> Finding:
        """The load of a recording."""
        load, fit, z = self.loads[i], self.fits[i], self.loads[i].mass / self.loads[i].mass_std
        centre = zip(("cx", "cy", "cz"), map(float, load.com_std), strict=True)
        spread = [float(x) for x in six_from_tensor(load.inertia_std)]
        return Finding(
            effect=HELD.name,
            title=HELD.title,
            joints=(),
            interval_s=(0.0, float(fit.recordings[0].t[-1])),
            lasting=True,
            parameters=HELD.decode(self.own[i][0]),
            std={"m": load.mass_std, **dict(centre), "inertia": spread},
            units=HELD.units(),
            evidence=math.erf(z / math.sqrt(2.0)),
            overlaps={},
            split_by="",
            detectability=z,
            torque_rms_nm=np.sqrt(np.mean(fit.model.contribution(0, 0) ** 2, axis=0)),
            recording=self.names[i],
        )


def _row(name: str, load: HandLoad) -> LogLoad:
    com = tuple(map(float, load.com)) if load.com_shown else None
    std = tuple(map(float, load.com_std)) if load.com_shown else None
    return LogLoad(name, load.is_there, load.mass, load.mass_std, com, std, load.frame)


def contradictions(fit: Fit, together: Together) -> list[Difference]:
    """Recordings that contradict the rest, the worst first, one after the other.

    Each recording's own correction of a friction, an offset or a link's inertia, about what all
    others say, is compared with such corrections of the others among themselves: the models of
    friction and of sensors are not exact, and how inexact shows in how much these differ.

    Args:
        fit: any of the recordings'.
    """
    out: list[Difference] = []
    std, places = np.diagonal(together.prior) ** -0.5, list(range(len(together.parts)))
    while len(places) >= 3:  # of two nobody can say which one is the odd one
        odd = _odd_one(fit, [together.parts[i] for i in places], std)
        if odd is None:
            break
        out.append(odd._replace(recording=places.pop(odd.recording)))
    return out


def _odd_one(fit: Fit, parts: Sequence[Part], std: Array) -> Difference | None:
    """The recording that differs from all others by more than these do, if there is one."""
    found = []
    for worst in map(max, _differences(fit, Together(parts, std)).values()):
        if worst.size < NOISE:
            continue
        others = Together([x for k, x in enumerate(parts) if k != worst.recording], std)
        among = max(_differences(fit, others)[worst.kind]).size
        if worst.size > OTHERS * max(among, 1.0):
            found.append(worst)
    return max(found, key=lambda x: x.chi2, default=None)


def _differences(fit: Fit, rest: Together) -> dict[str, list[Difference]]:
    """Of each kind, of every recording about all others."""
    found: dict[str, list[Difference]] = {FRICTION: [], OFFSET: [], LINK: []}
    for i, part in enumerate(rest.parts):
        x, covariance = rest.without(i)
        left, unsure = part.g - part.G @ x, part.G + part.G @ covariance @ part.G
        for kind, what, directions in _directions(fit, x):
            C, d = directions @ unsure @ directions.T, directions @ left
            inverse = np.linalg.inv(C + np.eye(len(C)))
            chi2, shown = float(d @ inverse @ d), max(float(np.trace(C @ inverse)), 0.5)
            found[kind].append(Difference(math.sqrt(chi2 / shown), chi2, i, kind, what))
    return found


def _directions(fit: Fit, x: Array) -> Iterator[tuple[str, str, Array]]:
    """Kind, words, and directions (k, c) in the common coefficients, of about unit deviation."""
    unit, own = np.eye(len(x)), [e.candidate for e in fit.named[1:]]
    widths = [len(e.x) for e in fit.named[1:]]
    at = len(x) - sum(widths) + np.cumsum([0, *widths[:-1]])  # where those of each begin
    rubs = np.array(["friction" in c.effect.name for c in own])
    reads = np.array([c.effect.name == "torque_offset" for c in own])
    joints = np.array([c.joint for c in own])
    yield FRICTION, "the friction of all joints", _together_in(unit, at[rubs], x)
    for j in range(fit.n):
        at_joint = _together_in(unit, at[rubs & (joints == j)], x)
        yield FRICTION, f"the friction of joint {j + 1}", at_joint
        yield OFFSET, f"the offset of joint {j + 1}'s torque", unit[at[reads & (joints == j)]]
    for k in range(1, fit.n - 1):
        moved = np.array(LINK_STD)[:, None] * unit[10 * k : 10 * k + 10]
        yield LINK, f"the inertia of link {k + 1}, or of one beside it,", moved


def _together_in(unit: Array, places: Array, x: Array) -> Array:
    """(1, c) coefficients at these places, in the proportion that they have."""
    return np.asarray((x[places] @ unit[places])[None])


@dataclass(frozen=True, eq=False)
class Part:
    """One recording's share.

    Attributes:
        known: of all its coefficients; own: (o,) places of its own; common: (c,) of the others.
        G: (c, c) what it knows of the common ones, its own eliminated; g: (c,) with its data.
        free: (o, o) covariance of its own where the common ones are known.
        cross: (o, c) its own with the common ones.
        rows: of the white signatures that a second has.
    """

    known: Carried
    own: np.ndarray
    common: np.ndarray
    G: Array
    g: Array
    free: Array
    cross: Array
    rows: int

    @classmethod
    def of(cls, fit: Fit, own: np.ndarray) -> Part:
        """From the fit of one recording."""
        known = fit.carried()
        common = np.delete(np.arange(len(known.g)), own)
        A = known.G[np.ix_(own, own)] + np.diag(known.prior_std[own] ** -2.0)
        free = cho_solve(cho_factor(A, lower=True), np.eye(len(own)))
        cross = known.G[np.ix_(own, common)]
        G = known.G[np.ix_(common, common)] - cross.T @ free @ cross
        g = known.g[common] - cross.T @ free @ known.g[own]
        return cls(known, own, common, G, g, free, cross, BLOCK * fit.n)

    def own_at(self, x: Array) -> Array:
        """(o,) its own coefficients where the common ones are x (c,)."""
        return np.asarray(self.free @ (self.known.g[self.own] - self.cross @ x))

    def all_at(self, x: Array) -> Array:
        """All its coefficients, in its order, where the common ones are x (c,)."""
        out = np.empty(len(self.known.g))
        out[self.common], out[self.own] = x, self.own_at(x)
        return out

    def scores(self, x: Array) -> tuple[Array, Array]:
        """Of its seconds, (s, c) what each adds to `g - G x`, and (s, o) to its own gradient."""
        left = self.known.data - self.all_at(x) @ self.known.N
        cuts = np.arange(0, len(left), self.rows)
        sums = np.add.reduceat(self.known.N * left, cuts, axis=1).T
        own = sums[:, self.own]
        return sums[:, self.common] - own @ self.free @ self.cross, own


class Together:
    """Recordings in one least squares.

    Args:
        parts: theirs, with the same common coefficients in the same order.
        prior_std: (c,) of the common coefficients.

    Attributes:
        x: (c,) the common coefficients; covariance: (c, c) of them.
    """

    def __init__(self, parts: Sequence[Part], prior_std: Array) -> None:
        self.parts, self.prior = parts, np.diag(prior_std**-2.0)
        self.G = np.sum([part.G for part in parts], axis=0) + self.prior
        self.g = np.sum([part.g for part in parts], axis=0)
        self.covariance = np.linalg.inv(self.G)
        self.x = self.covariance @ self.g

    @cached_property
    def scores(self) -> list[tuple[Array, Array]]:
        """Of each part, see there."""
        return [part.scores(self.x) for part in self.parts]

    @cached_property
    def spread(self) -> Array:
        """(c, c) by how much the seconds of all recordings disagree, and the prior with them."""
        return np.asarray(np.sum([x.T @ x for x, _ in self.scores], axis=0) + self.prior)

    def own(self, i: int) -> tuple[Array, Array]:
        """(o,) the i-th recording's own coefficients, and (o, o) their covariance.

        By the noise, and no less than by what seconds disagree: what a model gets wrong does not
        average out as noise does (White 1980, by clusters).
        """
        part, (common, mine) = self.parts[i], self.scores[i]
        H = part.free @ part.cross @ self.covariance
        plain = part.free + H @ part.cross.T @ part.free
        off = mine @ part.free - common @ H.T
        prior = np.diag(part.known.prior_std[part.own] ** -2.0)
        robust = off.T @ off + H @ (self.spread - common.T @ common) @ H.T
        robust += part.free @ prior @ part.free
        wider = np.sqrt(np.maximum(np.diagonal(robust) / np.diagonal(plain), 1.0))
        return part.own_at(self.x), plain * np.outer(wider, wider)

    def without(self, i: int) -> tuple[Array, Array]:
        """(c,) the common coefficients by all recordings but the i-th, and (c, c) covariance."""
        part = self.parts[i]
        covariance = np.linalg.inv(self.G - part.G)
        return covariance @ (self.g - part.g), covariance
