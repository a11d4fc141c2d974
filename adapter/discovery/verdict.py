"""What discovery answers: the tree, a confidence per edge, and sentences on what is undecided."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from adapter.discovery.arborescence import Search, Structure
from adapter.discovery.bodies import NO_JOINT, Bodies, bodies_of
from adapter.discovery.doubts import doubts_of
from adapter.discovery.hypotheses import FREE, Hypotheses, Option, hypotheses_of
from adapter.discovery.recorded import CUTOFF_HZ, Recorded, prepare
from adapter.errors import ModelError
from drivers.mcap_file import Log

UNSEEN_BASE = "base"  # name of a base at rest that is not in the recording
DECIDED = 0.9  # confidence from which an edge counts as decided
WORTH_TELLING = 0.001  # probability below which no rival is told


@dataclass(frozen=True)
class Edge:
    """A joint, the link it moves and the link that carries both.

    Attributes:
        joint: name; None for a link that rides on its parent without a joint.
        link, parent: names; parent None for a link that nothing carries.
        confidence: probability of the three together, given that the truth is among the
            hypotheses.
        rival: the next best (joint, parent) of the same link; None where nothing comes close.
    """

    joint: str | None
    link: str
    parent: str | None
    confidence: float
    rival: Edge | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        out = {key: getattr(self, key) for key in ("joint", "link", "parent", "confidence")}
        return {**out, "rival": None if self.rival is None else self.rival.as_dict()}


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
    structure: Structure
    hypotheses: Hypotheses

    @property
    def recorded(self) -> Recorded:
        """The signals."""
        return self.bodies.recorded

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        recorded = self.recorded
        jointed = [edge.as_dict() for edge in self.edges if edge.joint is not None]
        rigid = [edge.as_dict() for edge in self.edges if edge.joint is None and edge.parent]
        return {
            "root": self.root,
            "root_confidence": self.root_confidence,
            "joints": len(recorded.joint_names),
            "edges": jointed,
            "rigid": rigid,
            "undecided": list(self.undecided),
            "samples_used": recorded.samples,
            "duration_s": recorded.duration_s,
            "rate_hz": recorded.rate_hz,
            "measured": list(recorded.measured),
            "misfit_over_noise": dict(self.hypotheses.excess),
            "notes": list(recorded.notes),
        }


def discover(log: Log, cutoff_hz: float = CUTOFF_HZ) -> Discovery:
    """Find the tree of a recording with link motion; order and names decide nothing.

    Args:
        log: joint signals, and the motion of links in their own frames, whose z is their joint's
            axis (eq. 9).
        cutoff_hz: of the filter that everything goes through.

    Raises:
        SettingsError: the recording cannot serve; one sentence says why.
        ModelError: the joints don't move at all.
    """
    bodies = bodies_of(prepare(log, cutoff_hz))
    if bodies.resting.all():
        raise ModelError(
            f"{log.path}: no joint moves ({', '.join(log.joint_names)}); nothing can be told"
        )
    hypotheses = hypotheses_of(bodies)
    search = Search(hypotheses.options, len(log.joint_names))
    structure = search.best()
    if structure is None:
        raise ModelError(
            f"{log.path}: so much is undecided that no tree stands out; record more motion, of "
            "every joint and not all alike"
        )
    posterior = search.posterior(structure)
    return _discovery(bodies, hypotheses, structure, posterior)


def body_names(bodies: Bodies) -> tuple[str, ...]:
    """Names of links, and of the base that is not in the recording."""
    names = bodies.recorded.link_names
    return names if bodies.unseen_base is None else (*names, UNSEEN_BASE)


def _discovery(
    bodies: Bodies,
    hypotheses: Hypotheses,
    structure: Structure,
    posterior: list[list[tuple[Option, float]]],
) -> Discovery:
    names = body_names(bodies)
    edges = []
    roots: dict[str, float] = {}
    for option, ranked in zip(structure.chosen, posterior, strict=True):
        share = dict(ranked)[option]
        if option.parent == FREE:
            roots[names[option.link]] = share
        elif option.parent == bodies.unseen_base:
            roots[names[option.parent]] = max(share, roots.get(names[option.parent], 0.0))
        others = [(o, p) for o, p in ranked if o != option and p >= WORTH_TELLING]
        rival = _edge(bodies, *others[0]) if others else None
        edges.append(_edge(bodies, option, share, rival))
    order = {name: k for k, name in enumerate(bodies.recorded.joint_names)}
    edges.sort(key=lambda edge: order.get(edge.joint or "", len(order)))
    kept = tuple(edge for edge in edges if edge.parent is not None)
    single = len(roots) == 1
    return Discovery(
        root=next(iter(roots)) if single else None,
        root_confidence=next(iter(roots.values())) if single else 0.0,
        edges=kept,
        undecided=tuple(doubts_of(bodies, structure, posterior, names, DECIDED)),
        bodies=bodies,
        structure=structure,
        hypotheses=hypotheses,
    )


def _edge(bodies: Bodies, option: Option, share: float, rival: Edge | None = None) -> Edge:
    names = body_names(bodies)
    joint = None if option.joint == NO_JOINT else bodies.recorded.joint_names[option.joint]
    parent = None if option.parent == FREE else names[option.parent]
    return Edge(joint, names[option.link], parent, share, rival)
