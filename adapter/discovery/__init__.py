"""N and A unknown: from joint signals and link motion in any order to the tree (paper, sec. V).

>>> from adapter.discovery import discover, learn, self_model
"""

from adapter.discovery.learned import LearnedTree, learn, self_model
from adapter.discovery.prepare import CUTOFF_HZ
from adapter.discovery.verdict import DECIDED, UNSEEN_BASE, Discovery, Edge, discover

__all__ = [
    "CUTOFF_HZ",
    "DECIDED",
    "UNSEEN_BASE",
    "Discovery",
    "Edge",
    "LearnedTree",
    "discover",
    "learn",
    "self_model",
]
