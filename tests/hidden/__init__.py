"""Hidden-effect trials: `draw` a seed's trial, `write` its recording, nominal model and truth."""

from __future__ import annotations

from tests.hidden.record import pybullet_recording, simulate, write, write_files
from tests.hidden.trial import KINDS, SHARES, Trial, draw, nominal_urdf

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
