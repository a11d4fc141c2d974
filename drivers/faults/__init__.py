"""Faults to inject between an arm and its user: how they are written and what they do."""
