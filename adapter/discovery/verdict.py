"""What discovery answers: the tree, a confidence per edge, and sentences on what is undecided."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from adapter.discovery import tree_search
from adapter.discovery.axes import with_start
from adapter.discovery.bodies import NO_JOINT, Bodies, bodies_of
from adapter.discovery.frames import Mounting
from adapter.discovery.hypotheses import (
    FREE,
    FREE_RATIO,
    Hypotheses,
    Option,
    convention_misfit,
    hypotheses_of,
    keeps_convention,
    mounted_hypotheses,
)
from adapter.discovery.prepare import CUTOFF_HZ, PreparedLog, listed, prepare
from adapter.errors import ModelError
from drivers.files.mcap import Log

UNSEEN_BASE = "base"  # name of a base at rest that is not in the recording
DECIDED = 0.9  # confidence from which an edge counts as decided
WORTH_TELLING = 0.001  # probability below which no rival is told
ALIKE = 0.9999  # correlation of two joints' speeds above which they count as moving alike
TOLD = 0.05  # probability from which an alternative is told
MOST_TOLD = 4  # alternatives in one sentence


@dataclass(frozen=True)
class Edge:
    """A joint, the link it moves and the link that carries both.

    Attributes:
        joint: name; None for a link that rides on its parent without a joint.
        link, parent: names; parent None for a link that nothing carries.
        confidence: probability of the three together, given that the truth is among the
            hypotheses.
        connected: that of the joint between these two links, whichever carries the other.
        directed: whether the data tell which of the two does.
        rival: the next best (joint, parent) of the same link; None where nothing comes close.
    """

    joint: str | None
    link: str
    parent: str | None
    confidence: float
    connected: float
    directed: bool = True
    rival: Edge | None = None


@dataclass(frozen=True)
class Discovery:
    """What a recording says of the tree.

    Attributes:
        root: name of the link that carries all others; None where there is more than one.
        root_confidence: probability of that.
        edges: by joint; links without joint come last.
        undecided: sentences.
        bodies, structure, hypotheses: what it was found from.
    """

    root: str | None
    root_confidence: float
    edges: tuple[Edge, ...]
    undecided: tuple[str, ...]
    bodies: Bodies
    structure: tree_search.Structure
    hypotheses: Hypotheses

    def __repr__(self) -> str:
        open_ = f"{len(self.undecided)} left open" if self.undecided else "all decided"
        return f"Discovery({len(self.edges)} edges, root {self.root}, {open_})"

    @property
    def log(self) -> PreparedLog:
        """The filtered signals."""
        return self.bodies.log

    @property
    def mountings(self) -> dict[str, Mounting]:
        """Where the axis was found in the frames of links, by their names."""
        chosen = [option for option in self.structure.chosen if option.mounting is not None]
        names = self.log.link_names
        return {names[o.link]: o.mounting for o in chosen if o.mounting is not None}

    @property
    def notes(self) -> tuple[str, ...]:
        """What was done to the data and what they were taken for, one sentence each."""
        if not self.mountings:
            return self.log.notes
        names = self.log.link_names
        found = listed(names, np.array([name in self.mountings for name in names]))
        note = (
            f"frames of links {found} do not turn about their z with the "
            "origin on the axis: the axes were found, and λ is that of frames on them"
        )
        return (*self.log.notes, note)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        log = self.log
        jointed = [asdict(edge) for edge in self.edges if edge.joint is not None]
        rigid = [asdict(edge) for edge in self.edges if edge.joint is None and edge.parent]
        return {
            "root": self.root,
            "root_confidence": self.root_confidence,
            "joints": len(log.joint_names),
            "edges": jointed,
            "rigid": rigid,
            "undecided": list(self.undecided),
            "samples_used": log.samples,
            "duration_s": log.duration_s,
            "rate_hz": log.rate_hz,
            "measured": list(log.measured),
            "misfit_over_noise": dict(self.hypotheses.excess),
            "notes": list(self.notes),
            "mounting": {name: m.as_dict() for name, m in self.mountings.items()},
        }


def discover(log: Log, cutoff_hz: float = CUTOFF_HZ, base: str | None = None) -> Discovery:
    """Find the tree of a recording with link motion; order and names decide nothing.

    Link frames are first taken to turn about their z, with their origin on their joint's axis
    (eq. 9), which tells parent from child too. Where that leaves links unexplained, the axis may
    lie anyhow in each link's frame and is found. A floating base is then any link, unless it is
    said or frames of some links keep the convention; without either the most central one is taken.

    Args:
        log: joint signals, and the motion of links, each in a frame fixed to it.
        cutoff_hz: of the filter that everything goes through.
        base: name of the link that carries all others, if that is known.

    Raises:
        SettingsError: the recording cannot serve; one sentence says why.
        ModelError: the joints don't move at all, or no link has the base's name.
    """
    if base is not None and base not in log.link_names:
        raise ModelError(
            f"{log.path}: no link {base} in the recording to be the base; "
            f"choose from {', '.join(log.link_names)}"
        )
    number = None if base is None else log.link_names.index(base)
    bodies = bodies_of(with_start(prepare(log, cutoff_hz), number), number)
    if bodies.resting.all():
        raise ModelError(
            f"{log.path}: no joint moves ({', '.join(log.joint_names)}); nothing can be told"
        )
    misfit = convention_misfit(bodies)
    structure: tree_search.Structure | None = None
    if keeps_convention(bodies, misfit):
        hypotheses = hypotheses_of(bodies, misfit)
        structure = tree_search.TreeSearch(hypotheses.options, len(log.joint_names)).best()
    if structure is None or _unexplained(hypotheses, structure):
        hypotheses = mounted_hypotheses(bodies, misfit)
        structure = tree_search.TreeSearch(hypotheses.options, len(log.joint_names)).best()
    return _discovery(hypotheses, structure)


def _unexplained(hypotheses: Hypotheses, structure: tree_search.Structure) -> bool:
    """Whether the convention leaves links that nothing carries, joints that move none, or more
    misfit than noise does."""
    bodies = hypotheses.bodies
    used = {option.joint for option in structure.chosen}
    idle = any(s not in used for s in np.flatnonzero(~bodies.resting).tolist())
    free = sum(option.parent == FREE for option in structure.chosen)
    carried = any(option.parent == bodies.unseen_base for option in structure.chosen)
    return idle or free + carried > 1 or max(hypotheses.excess.values()) > FREE_RATIO


def body_names(bodies: Bodies) -> tuple[str, ...]:
    """Names of links, and of the base that is not in the recording."""
    names = bodies.log.link_names
    return names if bodies.unseen_base is None else (*names, UNSEEN_BASE)


def _discovery(hypotheses: Hypotheses, structure: tree_search.Structure) -> Discovery:
    bodies = hypotheses.bodies
    search = tree_search.TreeSearch(hypotheses.options, len(bodies.resting))
    shares: dict[int, dict[int, float]] = {}
    if hypotheses.mounted:
        structure = tree_search.central(search, bodies, structure)
        for root in tree_search.floating_roots(bodies, structure):
            shares[root] = tree_search.rootings(search, structure, root)
    posterior = search.posterior(structure, shares)
    edges, roots, confidence = _judged(bodies, structure, shares, posterior)
    order = {name: k for k, name in enumerate(bodies.log.joint_names)}
    edges.sort(key=lambda edge: order.get(edge.joint or "", len(order)))
    kept = tuple(edge for edge in edges if edge.parent is not None)
    single = len(roots) == 1
    return Discovery(
        root=next(iter(roots)) if single else None,
        root_confidence=next(iter(roots.values())) if single else 0.0,
        edges=kept,
        undecided=(
            *_open(bodies, structure, shares),
            *_undecided(bodies, structure, posterior, shares, confidence),
        ),
        bodies=bodies,
        structure=structure,
        hypotheses=hypotheses,
    )


def _judged(
    bodies: Bodies,
    structure: tree_search.Structure,
    shares: dict[int, dict[int, float]],
    posterior: Sequence[Sequence[tuple[Option, float]]],
) -> tuple[list[Edge], dict[str, float], list[float]]:
    """Every edge, the probability of each root by name, and of each link how sure its edge is."""
    names = body_names(bodies)
    edges: list[Edge] = []
    roots: dict[str, float] = {}
    confidence: list[float] = []
    for option, ranked in zip(structure.chosen, posterior, strict=True):
        way = _direction(structure, shares, option.link)
        share = dict(ranked)[option]
        if option.link in shares:
            share = roots[names[option.link]] = shares[option.link][option.link]
        elif option.parent == FREE:
            roots[names[option.link]] = share
        elif option.parent == bodies.unseen_base:
            roots[names[option.parent]] = max(share, roots.get(names[option.parent], 0.0))
        confidence.append(share * (way if way >= DECIDED else 1.0))
        others = [(o, p) for o, p in ranked if o != option and p >= WORTH_TELLING]
        rival = _edge(bodies, *others[0]) if others else None
        edge = _edge(bodies, option, share, rival)
        edges.append(replace(edge, confidence=way * share, directed=way >= DECIDED))
    return edges, roots, confidence


def _direction(
    structure: tree_search.Structure, shares: dict[int, dict[int, float]], link: int
) -> float:
    """Probability that a link is carried by its parent, not the other way round.

    The likeliest root that does not hang on the link is held against the likeliest that does: the
    number of links on either side of a joint says nothing.
    """
    below = set(tree_search.component(structure, link))
    for root, share in shares.items():
        if link != root and link in share:
            inside = max(share[k] for k in below)
            outside = max(p for k, p in share.items() if k not in below)
            return outside / (inside + outside)
    return 1.0


def _edge(bodies: Bodies, option: Option, share: float, rival: Edge | None = None) -> Edge:
    names = body_names(bodies)
    joint = None if option.joint == NO_JOINT else bodies.log.joint_names[option.joint]
    parent = None if option.parent == FREE else names[option.parent]
    return Edge(joint, names[option.link], parent, share, share, rival=rival)


# --- sentences on what is left open, why, and which motion would decide it ---------------------


def _open(
    bodies: Bodies, structure: tree_search.Structure, roots: Mapping[int, Mapping[int, float]]
) -> Iterator[str]:
    """`roots`: where a root is any link that moves, by it: which others it may be, how probably."""
    log, names, chosen = bodies.log, body_names(bodies), structure.chosen
    for s in np.flatnonzero(bodies.resting):
        speed = float(np.sqrt(np.mean(log.dq[:, s] ** 2)))
        yield (
            f"joint {log.joint_names[s]} does not move (rms {speed:.1g} rad/s, no more than "
            "its noise): which link it moves follows only from what the other joints leave over; "
            "move it"
        )
    for idle in sorted(set(range(len(log.joint_names))) - {option.joint for option in chosen}):
        yield (
            f"joint {log.joint_names[idle]} moves no link whose motion is in the recording; record "
            "the motion of the link that it moves"
        )
    free = [names[option.link] for option in chosen if option.parent == FREE]
    carried = [option for option in chosen if option.parent == bodies.unseen_base]
    if len(free) + bool(carried) > 1:
        yield (
            f"no joint and no other link in the recording make {', '.join(free)} move as they do; "
            "a base may be one of them. The links that carry them are not in the recording, their "
            "sensors are late or loose"
        )
    for option in chosen:
        if option.joint == NO_JOINT and option.parent != FREE:
            yield (
                f"links {names[option.link]} and {names[option.parent]} move as one body; a joint "
                "between them, if there is one, did not move"
            )
    for root, shares in roots.items():
        if shares[root] >= DECIDED:
            continue
        likely = sorted(shares.items(), key=lambda item: (-item[1], item[0] != root))
        told = " or ".join(f"{names[k]} ({p:.2f})" for k, p in likely[:MOST_TOLD] if p >= TOLD)
        told = told or f"any of {len(shares)} links, each as well"
        yield (
            f"which link is the base: {told}; with sensors mounted anyhow a joint looks the same "
            f"from either side, so only what it connects is told; {names[root]} is taken: name "
            "the base (--base)"
        )


def _undecided(
    bodies: Bodies,
    structure: tree_search.Structure,
    posterior: Sequence[tree_search.Ranked],
    roots: Mapping[int, Mapping[int, float]],
    confidence: Sequence[float],
) -> Iterator[str]:
    """`confidence`: by link, of what was chosen."""
    joints, names = bodies.log.joint_names, body_names(bodies)
    for own, ranked, sure in zip(structure.chosen, posterior, confidence, strict=True):
        if sure >= DECIDED or own.link in roots:
            continue
        told = [(o, p) for o, p in ranked if p >= TOLD or o == own][:MOST_TOLD]
        listed = " or ".join(f"{_said(o, joints, names)} ({p:.2f})" for o, p in told)
        more = sum(1 for _, p in ranked if p >= TOLD) - len(told)
        listed += f" or {more} more" if more > 0 else ""
        rival = next((o for o, _ in ranked if o != own), own)
        yield f"link {names[own.link]}: {listed}; {_remedy(bodies, own, rival, names)}"


def _said(option: Option, joints: Sequence[str], names: Sequence[str]) -> str:
    if option.parent == FREE:
        return "carried by nothing in the recording"
    if option.joint == NO_JOINT:
        return f"fixed to {names[option.parent]}"
    return f"moved by joint {joints[option.joint]} on {names[option.parent]}"


def _remedy(bodies: Bodies, own: Option, rival: Option, names: Sequence[str]) -> str:
    """Which motion would tell two options apart."""
    joints = bodies.log.joint_names
    pair = [o.joint for o in (own, rival) if o.joint != NO_JOINT]
    resting = [joints[s] for s in pair if bodies.resting[s]]
    if resting:
        return f"joint {' and '.join(dict.fromkeys(resting))} did not move: move it, by itself"
    dq, two = bodies.log.dq[:, pair], len(pair) == 2 and pair[0] != pair[1]
    if two and abs(float(np.corrcoef(dq[:, 0], dq[:, 1])[0, 1])) > ALIKE:
        both = " and ".join(joints[s] for s in pair)
        return f"joints {both} moved alike: move one without the other"
    parents = [o.parent for o in (own, rival) if o.parent != FREE]
    if len(parents) == 2 and parents[0] != parents[1]:
        first, second = (names[i] for i in parents)
        return (
            f"{first} and {second} moved too much alike: move the joints between them while joint "
            f"{joints[own.joint] if own.joint != NO_JOINT else 'of the link'} moves too"
        )
    said = "what is left unexplained is no smaller than the difference"
    return f"{said}: record longer or faster motion"
