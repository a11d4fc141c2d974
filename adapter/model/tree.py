"""Which link hangs on which: the topology N, A of the self (paper, eq. 1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from adapter.errors import ModelError

BASE = -1


@dataclass(frozen=True)
class Tree:
    """A tree of N revolute joints; link k is the one that joint k moves.

    Parents come before their children. With a floating base the base is a body too: it is row 0
    of θ and its six wrench rows [f; m] (on the base, in its frame) come first in τ.

    Attributes:
        parent: for each joint the index of the link it hangs on, -1 for the base.
        floating: whether the base moves freely.
        joint_names: N different names; numbered ones where not given.
        link_names: N different names; numbered ones where not given.
        base_name: the name of the base link.

    Raises:
        ModelError: no joints, a parent that does not come earlier, names that don't fit.
    """

    parent: tuple[int, ...]
    floating: bool = False
    joint_names: tuple[str, ...] = ()
    link_names: tuple[str, ...] = ()
    base_name: str = "base"

    def __post_init__(self) -> None:
        n = len(self.parent)
        if n == 0:
            raise ModelError("a tree needs at least one joint, got none")
        object.__setattr__(self, "parent", tuple(int(i) for i in self.parent))
        for k, i in enumerate(self.parent):
            if not BASE <= i < k:
                raise ModelError(
                    f"joint {k} hangs on link {i}; have: -1 (the base) or an earlier link, 0 to "
                    f"{k - 1} (number the links so that parents come first)"
                )
        for kind in ("joint", "link"):
            given = tuple(getattr(self, f"{kind}_names")) or _numbered(kind, n)
            object.__setattr__(self, f"{kind}_names", given)
            if len(given) != n:
                raise ModelError(f"{n} joints need {n} {kind} names, got {len(given)}")
            if len(set(given)) != n:
                raise ModelError(f"{kind} names must differ, got {', '.join(given)}")

    @property
    def n(self) -> int:
        """Number of joints N."""
        return len(self.parent)

    @property
    def bodies(self) -> int:
        """Rows of θ: N, or N + 1 with a floating base (base first)."""
        return self.n + int(self.floating)

    @property
    def rows(self) -> int:
        """Entries of τ: N, or 6 + N with a floating base (base wrench first)."""
        return self.n + 6 * int(self.floating)

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the rows of θ."""
        return ((self.base_name,) if self.floating else ()) + self.link_names

    @cached_property
    def adjacency(self) -> NDArray[np.int64]:
        """A, (N+1, N+1), symmetric, 1 where two links share a joint; row 0 is the base."""
        a = np.zeros((self.n + 1, self.n + 1), dtype=np.int64)
        for k, i in enumerate(self.parent):
            a[i + 1, k + 1] = a[k + 1, i + 1] = 1
        return a

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """For each link the links that hang on it."""
        return tuple(tuple(j for j, i in enumerate(self.parent) if i == k) for k in range(self.n))

    def path_to(self, link: int) -> tuple[int, ...]:
        """The joints from the base to `link`, in that order, its own last."""
        path = []
        while link != BASE:
            path.append(link)
            link = self.parent[link]
        return tuple(reversed(path))

    def joint_index(self, name: str) -> int:
        """Index of a joint by name. Raises ModelError with the names there are."""
        if name not in self.joint_names:
            raise ModelError(f"no joint '{name}'; have: {', '.join(self.joint_names)}")
        return self.joint_names.index(name)

    @classmethod
    def from_adjacency(
        cls,
        adjacency: ArrayLike,
        floating: bool = False,
        joint_names: Sequence[str] = (),
        link_names: Sequence[str] = (),
        base_name: str = "base",
    ) -> Tree:
        """The tree of a symmetric 0/1 matrix (N+1, N+1) whose row 0 is the base.

        Raises:
            ModelError: not square, not symmetric, not 0/1, loops or separate parts, or links
                not numbered parents first.
        """
        a = np.asarray(adjacency)
        if a.ndim != 2 or a.shape[0] != a.shape[1] or a.shape[0] < 2:
            raise ModelError(f"A must be (N+1, N+1) with N at least 1, got shape {a.shape}")
        if not (np.isin(a, (0, 1)).all() and (a == a.T).all() and not a.diagonal().any()):
            raise ModelError("A must be symmetric, hold only 0 and 1, and 0 on its diagonal")
        if a.sum() != 2 * (len(a) - 1):
            raise ModelError(
                f"A has {int(a.sum()) // 2} edges; a tree of {len(a)} links has {len(a) - 1}"
            )
        parent = []
        for k in range(1, len(a)):
            earlier = np.flatnonzero(a[k, :k])
            if len(earlier) != 1:
                raise ModelError(
                    f"link {k} of A has {len(earlier)} earlier neighbours, it needs exactly one: "
                    "the links form a loop, separate parts, or are not numbered parents first"
                )
            parent.append(int(earlier[0]) - 1)
        return cls(tuple(parent), floating, tuple(joint_names), tuple(link_names), base_name)


def _numbered(kind: str, n: int) -> tuple[str, ...]:
    """joint1, joint2, ... or link1, link2, ..."""
    return tuple(f"{kind}{k + 1}" for k in range(n))
