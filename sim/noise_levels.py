"""How large what the sensors add is. Light to load: wrong levels are told at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from drivers.errors import choices

NOISES = ("real", "none")


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Sizes of what the sensors add; scalars or one value per joint.

    Attributes:
        tau_above_50hz: torque noise above 50 Hz, N m rms; white over all frequencies.
        tau_10_to_40hz: torque noise between 10 and 40 Hz, share of the white noise included.
        tau_at_rest: share of the torque noise that is left in a joint at rest; all of it from
            0.1 rad/s on.
        tau_step: quantisation of the torque, N m; 0 for none.
        dq_above_50hz: velocity noise above 50 Hz, rad/s rms; white.
        q_above_50hz: position noise above 50 Hz, rad rms; white.
        link_twist: white noise on link twists, m/s and rad/s rms.
        link_accel: white noise on link accelerations, m/s² and rad/s² rms.
        dropouts: share of samples that never arrive.
        repeats: share of samples that carry the values of the one before.
        stamp_jitter_s: error of the stamp (not of the instant), s rms, cut at 0.45 periods.
    """

    tau_above_50hz: float | list[float] = 0.0
    tau_10_to_40hz: float | list[float] = 0.0
    tau_at_rest: float = 1.0
    tau_step: float | list[float] = 0.0
    dq_above_50hz: float | list[float] = 0.0
    q_above_50hz: float | list[float] = 0.0
    link_twist: float = 0.0
    link_accel: float = 0.0
    dropouts: float = 0.0
    repeats: float = 0.0
    stamp_jitter_s: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            if not np.all(np.asarray(getattr(self, item.name)) >= 0.0):
                raise ValueError(f"noise {item.name!r} is negative or not a number")
        if self.dropouts >= 1.0:
            raise ValueError(f"noise 'dropouts' is {self.dropouts}; have: below 1")


def check_levels(levels: Any) -> None:
    """Single noise levels that somebody wants to change.

    Raises:
        ValueError: no mapping of names to numbers from 0 up; with the names there are.
    """
    known = sorted(item.name for item in fields(NoiseLevels))
    if not isinstance(levels, Mapping):
        raise ValueError(
            f'levels is {levels!r}; have: {{"NAME": NUMBER, ...}} of {", ".join(known)}'
        )
    for key in levels.keys() - NoiseLevels.__dataclass_fields__.keys():
        raise ValueError(f"no noise level {key!r}; {choices(key, known)}")
    try:
        NoiseLevels(**levels)
    except TypeError:
        raise ValueError(f"noise levels {levels!r} are not numbers") from None
