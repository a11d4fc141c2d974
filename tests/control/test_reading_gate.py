"""A controller that gives up says why: the connection, or an encoder."""

import numpy as np
import pytest

from adapter.control.reading_gate import ReadingGate
from adapter.errors import ControlError
from drivers.damiao.timing import at_instant
from drivers.interface import JointSample

N, JOINT, PERIOD_NS = 4, 2, 1_000_000


def angle(t_s: float) -> tuple[float, float]:
    """q and dq of every joint."""
    return 0.3 * np.sin(8.0 * t_s), 2.4 * np.cos(8.0 * t_s)


def why_it_stops(hole: tuple[int, int], jump_rad: float, at: int = 300) -> str:
    """What is said where one joint's replies are missing in these ticks, and jump in one."""
    gate = ReadingGate(np.full(N, 2.5), np.full(N, 50.0), np.full(N, 60.0), PERIOD_NS)
    readings = [[(0, *angle(0.0), 1.0)] * 2 for _ in range(N)]
    for k in range(1, 400):
        for j in range(N):
            if j == JOINT and hole[0] <= k < hole[1]:
                continue
            q, dq = angle(1e-3 * k)
            q += jump_rad * (j == JOINT and k >= at)
            readings[j] = [readings[j][1], (k * PERIOD_NS, q, dq, 1.0)]
        stamp_ns = k * PERIOD_NS
        before, after = zip(*readings, strict=True)
        values, _ = at_instant(stamp_ns, before, after, 5 * PERIOD_NS)
        sample = JointSample(stamp_ns, *np.array(values).reshape(3, N))
        gate.look(sample, stamp_ns + 10**9)
        try:
            gate.usable(sample, sample.q)
        except ControlError as error:
            return str(error)
    return ""


def test_a_hole_on_a_bus_is_no_encoder() -> None:
    """The joint's motion is predicted, then unknown; then it is elsewhere."""
    said = why_it_stops((190, 206), 0.4, at=200)
    assert f"broke off and joint {JOINT + 1} is elsewhere" in said and "connection" in said


@pytest.mark.parametrize("hole", [(400, 400), (150, 153)])
def test_an_encoder_that_jumps_is_named(hole: tuple[int, int]) -> None:
    """Also long after a hole that did no harm."""
    said = why_it_stops(hole, 0.4)
    assert f"joint {JOINT + 1} reads what no joint can move to" in said and "encoder" in said
    assert why_it_stops(hole, 0.0) == ""
