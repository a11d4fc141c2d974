"""Faults to inject between an arm and its user: how they are written and what they do."""

from drivers.faults.spec import KINDS, Fault, Faults, Kind, usage_of

__all__ = ["KINDS", "Fault", "Faults", "Kind", "usage_of"]
