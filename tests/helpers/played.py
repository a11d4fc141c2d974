"""A motion from its start to rest, as a controller asks for it."""

from __future__ import annotations

import numpy as np


def played(motion, stop_s, dt_s):
    """q, dq, ddq (m, n) every dt_s, the stop asked for at stop_s."""
    rows = [[motion.q, motion.dq, motion.ddq]]
    while not motion.at_rest:
        if motion.time_s >= stop_s:
            motion.begin_stop()
        motion.advance(dt_s)
        rows.append([motion.q, motion.dq, motion.ddq])
    return np.moveaxis(np.array(rows), 1, 0)
