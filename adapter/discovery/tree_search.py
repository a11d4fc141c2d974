"""The most likely tree: every link one option, no joint twice, nobody his own ancestor.

Without the last demand it is a linear assignment of links to joints. Where its solution has a
cycle, one of the cycle's options must go: the problem splits into as many, each with one option
forbidden, and the best bound is looked at first, so the first solution without a cycle is the best.

Where frames may be any and no link is known to rest, a joint is the same seen from either side, so
every link of a tree may be its root and explain all motion as well. Only frames that keep the
convention, a link at rest or a word of the user tell.
"""

from __future__ import annotations

import heapq
from collections.abc import Collection
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import shortest_path

from adapter.discovery.bodies import NO_JOINT, Bodies
from adapter.discovery.hypotheses import FREE, LOST, Option
from adapter.model.spatial import Array

NEVER = -1e12  # score of what is not possible
MOST_SPLITS = 2000  # of the search for the tree; more ambiguity than that is left undecided
MOST_RIVAL_SPLITS = 30  # of the search for a rival, which else counts with its bound
TIED = 0.01  # log odds between roots that decide nothing

Key = tuple[int, int, int]
Ranked = list[tuple[Option, float]]


@dataclass(frozen=True)
class Structure:
    """One option for every link, and their scores' sum."""

    chosen: tuple[Option, ...]
    score: float


def key_of(option: Option) -> Key:
    """What tells options apart."""
    return option.link, option.joint, option.parent


class TreeSearch:
    """Finds the best structure, also with one link's option given.

    Args:
        options: by link, best first, a free one among them.
        joints: how many there are.
    """

    def __init__(self, options: tuple[tuple[Option, ...], ...], joints: int) -> None:
        self._options, self._joints = options, joints
        # a column of its own for each link without joint; each cell's options, best first
        self._scores: Array = np.full((len(options), joints + len(options)), NEVER)
        self._cells: dict[tuple[int, int], list[Option]] = {}
        for own in options:
            for option in sorted(own, key=lambda o: -o.score):
                cell = self._cells.setdefault(self._cell(option), [])
                cell.append(option)
                self._scores[self._cell(option)] = cell[0].score

    def _cell(self, option: Option) -> tuple[int, int]:
        column = self._joints + option.link if option.joint == NO_JOINT else option.joint
        return option.link, column

    def best(self) -> Structure:
        """The best structure; where the search was given up one of many that are about as good.

        The latter shows in the posterior, as other options count with bounds on their score.
        """
        structure, _ = self._search(None, MOST_SPLITS)
        return structure or self._greedy()

    def rooted_at(self, link: int) -> tuple[Structure | None, float]:
        """The best structure in which nothing carries a link, and its score or a bound on it."""
        return self._search(self._free(link), MOST_RIVAL_SPLITS)

    def _free(self, link: int) -> Option:
        return next(o for o in self._options[link] if o.parent == FREE)

    def _search(self, given: Option | None, splits: int) -> tuple[Structure | None, float]:
        """The best structure with one option given, and its score; or None and a bound on it."""
        # Of equals the newest is looked at first, so that a search among ties gets to an end.
        tie, seen = count(0, -1), set()
        first = self._assign(frozenset(), given)
        if first is None:
            return None, NEVER
        heap: list[tuple[float, int, frozenset[Key], Structure]] = []
        heapq.heappush(heap, (-first.score, next(tie), frozenset(), first))
        for _ in range(splits):
            if not heap:
                return None, NEVER
            _, _, forbidden, structure = heapq.heappop(heap)
            ring = cycle(structure.chosen)
            if not ring:
                return structure, structure.score
            for option in ring:
                if given is not None and option.link == given.link:
                    continue
                more = forbidden | {key_of(option)}
                if more in seen:
                    continue
                seen.add(more)
                split = self._assign(more, given)
                if split is not None:
                    heapq.heappush(heap, (-split.score, next(tie), more, split))
        return None, -heap[0][0] if heap else NEVER

    def _assign(self, forbidden: frozenset[Key], given: Option | None) -> Structure | None:
        scores = self._scores.copy()
        changed: dict[tuple[int, int], Option] = {}
        for link, joint, _ in forbidden:
            cell = link, self._joints + link if joint == NO_JOINT else joint
            left = (o for o in self._cells[cell] if key_of(o) not in forbidden)
            option = next(left, None)
            scores[cell] = NEVER if option is None else option.score
            if option is not None:
                changed[cell] = option
        if given is not None:
            cell = self._cell(given)
            scores[given.link] = NEVER
            scores[cell], changed[cell] = given.score, given
        rows, columns = linear_sum_assignment(scores, maximize=True)
        total = float(scores[rows, columns].sum())
        if total <= NEVER / 2:
            return None
        pairs = list(zip(rows.tolist(), columns.tolist(), strict=True))
        return Structure(tuple(changed.get(at) or self._cells[at][0] for at in pairs), total)

    def _greedy(self) -> Structure:
        """A tree from the best options on; what is left is free."""
        chosen = [self._free(link) for link in range(len(self._options))]
        taken: set[int] = set()
        every = sorted((o for own in self._options for o in own), key=lambda o: -o.score)
        for option in every:
            if chosen[option.link].parent != FREE or option.parent == FREE:
                continue
            if option.joint in taken or option.score <= chosen[option.link].score:
                continue
            before = chosen[option.link]
            chosen[option.link] = option
            if cycle(tuple(chosen)):
                chosen[option.link] = before
            elif option.joint != NO_JOINT:
                taken.add(option.joint)
        return Structure(tuple(chosen), sum(option.score for option in chosen))

    def posterior(self, structure: Structure, roots: Collection[int] = ()) -> list[Ranked]:
        """For every link its options and their probabilities, most likely first.

        The probability of an option is that of the best structure with it, over the sum of the
        same of all options. `roots` are taken for certain.
        """
        given = tuple(
            (self._free(link),) if link in roots else own for link, own in enumerate(self._options)
        )
        search = TreeSearch(given, self._joints)
        tops = np.array([options[0].score for options in given])
        out = []
        for link, options in enumerate(given):
            others = tops.sum() - tops[link]
            own = structure.chosen[link]
            scores = {own: structure.score}
            near = [o for o in options if others + o.score >= structure.score - LOST]
            for option in near[:30]:  # options of one link that are tried one by one
                if option != own:
                    _, scores[option] = search._search(option, MOST_RIVAL_SPLITS)
            top = max(scores.values())
            weights = {o: float(np.exp(s - top)) for o, s in scores.items()}
            total = sum(weights.values())
            ranked = sorted(weights.items(), key=lambda item: (-item[1], item[0] != own))
            out.append([(o, w / total) for o, w in ranked])
        return out


def cycle(chosen: tuple[Option, ...]) -> list[Option]:
    """Options of a ring of links that hang on one another; [] where there is none."""
    done: set[int] = set()
    for option in chosen:
        path: list[int] = []
        link = option.link
        while 0 <= link < len(chosen) and link not in done:
            if link in path:
                return [chosen[k] for k in path[path.index(link) :]]
            path.append(link)
            parent = chosen[link].parent
            link = parent if parent != FREE else len(chosen)
        done.update(path)
    return []


# --- which link carries all others -------------------------------------------------------------


def floating_roots(bodies: Bodies, structure: Structure) -> list[int]:
    """Links that move though nothing carries them, and were not said to be the base."""
    free = [option.link for option in structure.chosen if option.parent == FREE]
    return [link for link in free if not bodies.at_rest[link] and link != bodies.base]


def rootings(search: TreeSearch, structure: Structure, root: int) -> dict[int, float]:
    """Probability that each link of the part of the tree that hangs on `root` carries it."""
    members = component(structure, root)
    scores = {link: search.rooted_at(link)[1] for link in members}
    top = max(scores.values())
    weight = {link: float(np.exp(score - top)) for link, score in scores.items()}
    total = sum(weight.values())
    return {link: w / total for link, w in weight.items()}


def central(search: TreeSearch, bodies: Bodies, structure: Structure) -> Structure:
    """Of structures that tie but for the root that of the root nearest to all other links."""
    roots = floating_roots(bodies, structure)
    if len(roots) != 1:
        return structure
    shares = rootings(search, structure, roots[0])
    tied = [k for k, share in shares.items() if share >= max(shares.values()) * np.exp(-TIED)]
    if len(tied) < 2:
        return structure
    joined = np.zeros((len(structure.chosen), len(structure.chosen)))
    for option in structure.chosen:
        if 0 <= option.parent < len(joined):
            joined[option.link, option.parent] = 1.0
    distance = shortest_path(joined, directed=False)  # joints between any two links
    best = min(tied, key=lambda k: (sum(distance[k, i] for i in shares), k))
    return search.rooted_at(best)[0] or structure


def component(structure: Structure, root: int) -> list[int]:
    """The links that hang on `root`, itself included."""
    members = [root]
    for link in members:
        members += [option.link for option in structure.chosen if option.parent == link]
    return members
