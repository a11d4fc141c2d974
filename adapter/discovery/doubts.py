"""Sentences on what a recording leaves open, why, and which motion would decide it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adapter.discovery.arborescence import Ranked, Structure
from adapter.discovery.bodies import NO_JOINT, Bodies
from adapter.discovery.hypotheses import FREE, Option

ALIKE = 0.9999  # correlation of two joints' speeds above which they count as moving alike
TOLD = 0.05  # probability from which an alternative is told
MOST_TOLD = 4  # alternatives in one sentence


@dataclass(frozen=True)
class Verdicts:
    """What was made of the beliefs.

    Attributes:
        names: of bodies; confidence: by link, of what was chosen.
        roots: where a root is any link that moves, by it: which others it may be, how probably.
        decided: confidence from which something counts as decided.
    """

    names: Sequence[str]
    confidence: Sequence[float]
    roots: Mapping[int, Mapping[int, float]]
    decided: float


def doubts_of(
    bodies: Bodies, structure: Structure, posterior: Sequence[Ranked], verdicts: Verdicts
) -> list[str]:
    """All that is undecided, one sentence each."""
    return [
        *_resting(bodies),
        *_idle(bodies, structure),
        *_roots(bodies, structure, verdicts.names),
        *_either_way(verdicts),
        *_undecided(bodies, structure, posterior, verdicts),
    ]


def _resting(bodies: Bodies) -> Iterator[str]:
    recorded = bodies.recorded
    for s in np.flatnonzero(bodies.resting):
        speed = float(np.sqrt(np.mean(recorded.dq[:, s] ** 2)))
        yield (
            f"joint {recorded.joint_names[s]} does not move (rms {speed:.1g} rad/s, no more than "
            "its noise): which link it moves follows only from what the other joints leave over; "
            "move it"
        )


def _idle(bodies: Bodies, structure: Structure) -> Iterator[str]:
    used = {option.joint for option in structure.chosen}
    recorded = bodies.recorded
    for s, name in enumerate(recorded.joint_names):
        if s not in used:
            yield (
                f"joint {name} moves no link whose motion is in the recording; record the motion "
                "of the link that it moves"
            )


def _roots(bodies: Bodies, structure: Structure, names: Sequence[str]) -> Iterator[str]:
    free = [names[option.link] for option in structure.chosen if option.parent == FREE]
    carried = [option for option in structure.chosen if option.parent == bodies.unseen_base]
    if len(free) + bool(carried) > 1:
        yield (
            f"no joint and no other link in the recording make {', '.join(free)} move as they do; "
            "a base may be one of them. The links that carry them are not in the recording, their "
            "sensors are late or loose"
        )
    for option in structure.chosen:
        if option.joint == NO_JOINT and option.parent != FREE:
            yield (
                f"links {names[option.link]} and {names[option.parent]} move as one body; a joint "
                "between them, if there is one, did not move"
            )


def _either_way(verdicts: Verdicts) -> Iterator[str]:
    names = verdicts.names
    for root, shares in verdicts.roots.items():
        if shares[root] >= verdicts.decided:
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
    bodies: Bodies, structure: Structure, posterior: Sequence[Ranked], verdicts: Verdicts
) -> Iterator[str]:
    joints, names = bodies.recorded.joint_names, verdicts.names
    for own, ranked, sure in zip(structure.chosen, posterior, verdicts.confidence, strict=True):
        if sure >= verdicts.decided or own.link in verdicts.roots:
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
    joints = bodies.recorded.joint_names
    pair = [o.joint for o in (own, rival) if o.joint != NO_JOINT]
    resting = [joints[s] for s in pair if bodies.resting[s]]
    if resting:
        return f"joint {' and '.join(dict.fromkeys(resting))} did not move: move it, by itself"
    if len(pair) == 2 and pair[0] != pair[1] and _alike(bodies, *pair):
        return (
            f"joints {joints[pair[0]]} and {joints[pair[1]]} moved alike: move one without the "
            "other"
        )
    parents = [o.parent for o in (own, rival) if o.parent != FREE]
    if len(parents) == 2 and parents[0] != parents[1]:
        first, second = (names[i] for i in parents)
        return (
            f"{first} and {second} moved too much alike: move the joints between them while joint "
            f"{joints[own.joint] if own.joint != NO_JOINT else 'of the link'} moves too"
        )
    return (
        "what is left unexplained is no smaller than the difference: record longer or faster motion"
    )


def _alike(bodies: Bodies, first: int, second: int) -> bool:
    dq = bodies.recorded.dq
    return abs(float(np.corrcoef(dq[:, first], dq[:, second])[0, 1])) > ALIKE
