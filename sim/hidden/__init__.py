"""Hidden-effect trials: `draw` a seed's trial, `write` its recording, nominal model and truth."""

from __future__ import annotations

from sim.hidden.record import pybullet_recording, simulate, write, write_files
from sim.hidden.trial import KINDS, SHARES, Trial, draw, nominal_urdf

__all__ = [
    "KINDS",
    "SHARES",
    "Trial",
    "draw",
    "nominal_urdf",
    "pybullet_recording",
    "simulate",
    "write",
    "write_files",
]
