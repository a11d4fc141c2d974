"""Which link hangs on which: the topology N, A of the self (paper, eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from adapter.errors import ModelError
from drivers.errors import choices

BASE = -1


@dataclass(frozen=True)
class Tree:
    """A tree of N joints that turn or slide; link k is the one that joint k moves.

    Parents come before their children. With a floating base the base is a body too: it is row 0
    of θ and its six wrench rows [f; m] (on the base, in its frame) come first in τ.

    Attributes:
        parent: for each joint the index of the link it hangs on, -1 for the base.
        floating: whether the base moves freely.
        joint_names: N different names; numbered ones where not given.
        link_names: N different names; numbered ones where not given.
        base_name: the name of the base link.
        slides: for each joint whether it slides along its axis (prismatic) or turns about it; none
            slides where not given. Its q, dq, ddq and force are then m, m/s, m/s² and N.

    Raises:
        ModelError: no joints, a parent that does not come earlier, names that don't fit.
    """

    parent: tuple[int, ...]
    floating: bool = False
    joint_names: tuple[str, ...] = ()
    link_names: tuple[str, ...] = ()
    base_name: str = "base"
    slides: tuple[bool, ...] = ()

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
            numbered = tuple(f"{kind}{k + 1}" for k in range(n))
            given = tuple(getattr(self, f"{kind}_names")) or numbered
            object.__setattr__(self, f"{kind}_names", given)
            if len(given) != n:
                raise ModelError(f"{n} joints need {n} {kind} names, got {len(given)}")
            if len(set(given)) != n:
                raise ModelError(f"{kind} names must differ, got {', '.join(given)}")
        object.__setattr__(self, "slides", tuple(map(bool, self.slides)) or (False,) * n)
        if len(self.slides) != n:
            raise ModelError(f"{n} joints need {n} entries of slides, got {len(self.slides)}")

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

    def unit(self, turning: str, sliding: str, joint: int | None = None) -> str:
        """The unit of a joint (from 0), or of all: `N m (N of joint 1)` where the first slides."""
        if joint is not None:
            return sliding if self.slides[joint] else turning
        own = [str(j + 1) for j, slides in enumerate(self.slides) if slides]
        return f"{turning} ({sliding} of joint {', '.join(own)})" if own else turning

    def joint_index(self, name: str) -> int:
        """Index of a joint by name. Raises ModelError with the names there are."""
        if name not in self.joint_names:
            raise ModelError(f"no joint '{name}'; {choices(name, self.joint_names)}")
        return self.joint_names.index(name)
