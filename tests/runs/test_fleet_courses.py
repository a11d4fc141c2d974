"""What drifts and what stands out among recordings: on numbers whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from adapter.runs.fleet.course import Drift, Series, StandsOut, courses

PARAMETERS = 28  # of seven joints


def drawn(
    size: int, seed: int, drift: float = 0.0, off: float = 0.0, warm: float = 0.0
) -> tuple[list[Drift], list[StandsOut]]:
    """Parameters whose standard deviations are wrong by a factor; the first ones are moved.

    Args:
        drift, warm: of the first one over all time and temperature, off: of the second one in the
            first recording, all in standard deviations of the scatter.
    """
    rng = np.random.default_rng([seed, size])
    time = np.sort(rng.uniform(0.0, 30.0, size))
    columns = {"time": time, "temperature": 20.0 + 10.0 * rng.uniform(size=size)}
    series = []
    for k in range(PARAMETERS):
        own = rng.lognormal(0.0, 0.5) if k else 1.0
        std = np.full(size, 3.0 * own)  # three times what they scatter
        values = 5.0 + own * rng.standard_normal(size)
        if k == 0:
            values += own * (drift * time / 30.0 + warm * (columns["temperature"] - 20.0) / 10.0)
        if k == 1:
            values[0] += off * own
        series.append(Series(f"p{k}", 1, values, std))
    return courses(series, columns)


def test_where_nothing_drifts_hardly_anything_is_said_to() -> None:
    """One arm in a hundred may: of 150, more than eight would be 1 in 10 000."""
    found = [drawn(8, seed) for seed in range(150)]
    assert sum(bool(drifts) for drifts, _ in found) <= 8
    assert sum(bool(out) for _, out in found) <= 8


@pytest.mark.parametrize("size", [8, 30])
def test_what_drifts_is_found_with_its_slope(size: int) -> None:
    found = [drawn(size, seed, drift=15.0)[0] for seed in range(20)]
    named = [x for drifts in found for x in drifts if x.effect == "p0"]
    assert len(named) >= 18 and all(x.follows == "time" for x in named)
    off = np.array([(30.0 * x.slope - 15.0) / (30.0 * x.std) for x in named])
    assert np.mean(np.abs(off) < 3.0) > 0.9 and np.sqrt(np.mean(off**2)) < 2.0


def test_temperature_is_told_from_time() -> None:
    found = [drawn(12, seed, warm=15.0)[0] for seed in range(20)]
    named = [x for drifts in found for x in drifts if x.effect == "p0"]
    assert len(named) >= 18
    assert sum(x.follows == "temperature" and not x.rivals for x in named) >= 17


def test_columns_that_go_together_are_rivals() -> None:
    time = np.arange(10.0)
    rng = np.random.default_rng(0)
    flat = [Series(f"p{k}", 1, rng.normal(size=10), np.ones(10)) for k in range(6)]
    rising = Series("worn", 1, 3.0 * time + rng.normal(size=10), np.ones(10))
    (drift,), out = courses([*flat, rising], {"time": time, "age": 2.0 * time + 1.0})
    assert {drift.follows, *drift.rivals} == {"time", "age"} and not out


def test_one_that_stands_out_is_named_and_hides_no_drift() -> None:
    found = [drawn(12, seed, drift=15.0, off=15.0) for seed in range(20)]
    named = [[(x.effect, x.number) for x in out] for _, out in found]
    assert sum(("p1", 0) in x for x in named) >= 18
    assert all(x.count(("p1", 0)) <= 1 for x in named)
    assert all(abs(x.expected - 5.0) < 6.0 for _, out in found for x in out)


def test_a_few_numbers_say_nothing() -> None:
    four = Series("p", 1, np.arange(4.0), np.ones(4))
    assert courses([four], {"time": np.arange(4.0)}) == ([], [])
    nobody_told = {"time": np.zeros(9), "temperature": np.full(9, np.nan)}
    nine = Series("p", 1, np.arange(9.0), np.ones(9))
    assert courses([nine], nobody_told) == ([], [])
