"""N and A unknown: from joint signals and link motion in any order to the tree (paper, sec. V)."""

from adapter.discovery.verdict import Discovery, Edge, discover

__all__ = ["Discovery", "Edge", "discover"]
