"""When a run counts as settled, and over which rows an error is taken."""

import numpy as np
import pytest

from adapter.runs.outcome import collect
from adapter.runs.score import (
    Course,
    counted_from,
    figures,
    reference_from,
    settled_at,
    trailing_rms,
)
from tests.helpers.arm_data import Motion, arm, learner_for, panda_model, record, states_of, teach


@pytest.mark.parametrize(
    ("good", "at"),
    [
        ("1111", 0.0),
        ("0111", 0.1),
        ("0101", 0.3),  # it was good once before
        ("1101", 0.3),
        ("1110", None),
        ("0000", None),
    ],
)
def test_settled_is_what_stays_good_to_the_end(good: str, at: float | None) -> None:
    times = 0.1 * np.arange(4)
    found = settled_at(times, np.array([c == "1" for c in good]))
    assert found is None if at is None else found == pytest.approx(at)


def test_nothing_is_never_settled() -> None:
    assert settled_at(np.zeros(0), np.zeros(0, dtype=bool)) is None


def test_the_error_of_the_last_window_is_that_of_its_rows_alone() -> None:
    rng = np.random.default_rng(1)
    times, error = np.cumsum(rng.uniform(0.01, 0.05, 80)), rng.normal(size=(80, 3))
    found = trailing_rms(times, error, 0.5)
    for k, now in enumerate(times):
        rows = (times >= now - 0.5) & (times <= now)
        assert found[k] == pytest.approx(np.sqrt(np.mean((error[rows] ** 2).sum(axis=1))))


def test_what_settled_in_the_slow_phase_did_not_do_so_before_the_motion() -> None:
    """Times count from the end of the slow phase, and none is negative."""
    data = record(arm(), Motion(4.0, 0), links=False)
    robot, outcome = panda_model(), collect(teach(learner_for(seed=0), states_of(data)))
    reference, first_ns = reference_from(None, robot), int(outcome.schema_trace[0, 0])
    said = [
        figures(outcome, robot, reference, Course(1, {}, first_ns, 0.0, slow_s=slow_s))
        for slow_s in (0.0, 60.0)
    ]
    usual, slow = (x["lambda"]["converged_s"] for x in said)
    assert usual > 0.0 and slow == 0.0 and said[1]["theta"]["started_s"] == 0.0
    assert [counted_from(x) for x in said] == ["the first motion", "the slow phase"]
