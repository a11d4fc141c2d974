"""Which link carries all others, where frames may be any and no link is known to rest.

Seen from either side a joint is the same, so every link of a tree may be its root and explain
all motion as well. Only frames that keep the convention, a link at rest or a word of the user tell.
"""

from __future__ import annotations

import numpy as np

from adapter.discovery.arborescence import Search, Structure
from adapter.discovery.bodies import Bodies
from adapter.discovery.hypotheses import FREE

TIED = 0.01  # log odds that decide nothing


def floating_roots(bodies: Bodies, structure: Structure) -> list[int]:
    """Links that move though nothing carries them, and were not said to be the base."""
    free = [option.link for option in structure.chosen if option.parent == FREE]
    return [link for link in free if not bodies.at_rest[link] and link != bodies.base]


def rootings(search: Search, structure: Structure, root: int) -> dict[int, float]:
    """Probability that each link of the part of the tree that hangs on `root` carries it."""
    members = component(structure, root)
    scores = {link: search.score_of_root(link) for link in members}
    top = max(scores.values())
    weight = {link: float(np.exp(score - top)) for link, score in scores.items()}
    total = sum(weight.values())
    return {link: w / total for link, w in weight.items()}


def central(search: Search, bodies: Bodies, structure: Structure) -> Structure:
    """Of structures that tie but for the root that of the root nearest to all other links."""
    roots = floating_roots(bodies, structure)
    if len(roots) != 1:
        return structure
    shares = rootings(search, structure, roots[0])
    tied = [k for k, share in shares.items() if share >= max(shares.values()) * np.exp(-TIED)]
    if len(tied) < 2:
        return structure
    distance = _distances(structure)
    best = min(tied, key=lambda k: (sum(distance[k, i] for i in shares), k))
    return search.rooted_at(best) or structure


def component(structure: Structure, root: int) -> list[int]:
    """The links that hang on `root`, itself included."""
    members = [root]
    for link in members:
        members += [option.link for option in structure.chosen if option.parent == link]
    return members


def _distances(structure: Structure) -> np.ndarray:
    """Joints between any two links, (links, links); many where no path leads."""
    n = len(structure.chosen)
    out = np.full((n, n), 2 * n)
    np.fill_diagonal(out, 0)
    for option in structure.chosen:
        if 0 <= option.parent < n:
            out[option.link, option.parent] = out[option.parent, option.link] = 1
    for k in range(n):
        out = np.minimum(out, out[:, k, None] + out[None, k])
    return out
