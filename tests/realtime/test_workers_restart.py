"""A learner that is killed is followed by one that learns exactly what it would have learned."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from adapter.realtime.session import run_lockstep
from adapter.runs.config import PipelineSettings
from adapter.runs.live import learner_job, single_thread_learner
from adapter.runs.outcome import collect
from tests.helpers import live_tools as tools

pytestmark = [pytest.mark.alone, pytest.mark.usefixtures("no_leftovers")]

# Some seconds, so that successors, who take seconds to start, take over while the arm moves.
RUN_S = 3.5


def _whole(duration_s: float):
    """What a learner learns that nobody kills."""
    learner = tools.Digest()
    run_lockstep(tools.Swinging(), tools.parts()[0], learner, None, duration_s)
    return learner.summary()


def test_a_killed_learner_is_followed_by_one_that_learns_what_it_would_have(monkeypatch):
    monkeypatch.setenv("TEST_DEATHS", "700 1900")
    lines: list[str] = []
    job, options = tools.lasting_job(tools.Mortal), tools.live_options(RUN_S)
    result = tools.live(tools.Swinging(), options, say=lines.append, learner=job)
    print("\n".join(result.timing.lines()))
    assert (result.ended, result.fault) == ("duration", None)
    assert (result.restarts, result.skipped, result.unlearned) == (2, 0, 0)
    assert result.collected == _whole(RUN_S) and result.collected[0] == result.passed_on
    assert len(result.troubles) == 2 and set(result.troubles) < set(lines)
    assert "exit code -9" in result.troubles[0]
    assert "a new one starts (1 of 3)" in result.troubles[0]


def test_one_that_dies_at_the_very_end_is_followed_as_well(monkeypatch):
    monkeypatch.setenv("TEST_DEATHS", str(_whole(1.0)[0]))
    job = tools.lasting_job(tools.Mortal)
    result = tools.live(tools.Swinging(), tools.live_options(1.0), learner=job)
    assert (result.restarts, result.skipped) == (1, 0) and result.collected == _whole(1.0)


def _disk_full(learner, folder: Path) -> None:
    raise OSError(28, "No space left on device")


def test_what_nobody_can_learn_any_more_is_counted(monkeypatch):
    monkeypatch.setenv("TEST_DEATHS", "1500")
    job = replace(tools.lasting_job(tools.Mortal), keep=_disk_full)
    result = tools.live(tools.Swinging(), tools.live_options(2.0, ring_s=1.0), learner=job)
    learned, in_order, _ = result.collected
    assert result.restarts == 1 and result.skipped > 500 and in_order
    assert learned + result.skipped == result.passed_on
    assert result.passed_on + result.unlearned == _whole(2.0)[0]


def test_one_that_always_dies_is_given_up(tmp_path):
    jobs = {"learner": tools.lasting_job(tools.Dying)}
    jobs["recording"] = tools.recording_job(tmp_path / "a.mcap")
    result = tools.live(tools.Swinging(), tools.live_options(1.0), **jobs)
    assert result.restarts == 3 and result.collected is None
    assert len(result.troubles) == 4 and "nothing more is learned" in result.troubles[-1]
    assert result.ended == "duration" and result.recorded == result.samples


def _mortal_learner(documented, settings):
    """The real learner; killed after so many states."""
    learner = single_thread_learner(documented, settings, None)
    step, deaths = learner.step, os.environ["TEST_DEATHS"].split()

    def step_or_die(record) -> None:
        step(record)
        if str(learner.learned) in deaths:
            tools.die_once(str(learner.learned))

    learner.step = step_or_die
    return learner


def test_the_real_learner_goes_on_bit_for_bit(monkeypatch):
    monkeypatch.setenv("TEST_DEATHS", "2500")
    settings, duration_s = PipelineSettings(), 4.0
    job = learner_job(tools.PANDA, settings)
    job = replace(job, make=partial(_mortal_learner, tools.PANDA, settings), save_s=1.0)
    options = tools.live_options(duration_s, ring_s=60.0)
    result = tools.live(tools.simulated_arm(), options, moving=True, learner=job)
    assert (result.ended, result.restarts, result.skipped) == ("duration", 1, 0)

    whole = single_thread_learner(tools.PANDA, settings, None)
    front_end, controller = tools.parts()
    run_lockstep(tools.simulated_arm(), front_end, whole, controller, duration_s)
    expected, found = collect(whole), result.collected
    assert found.learned == expected.learned == result.passed_on > 4000
    assert found.theta_started_ns == expected.theta_started_ns is not None
    for name in ("lam", "theta", "effects", "covariance", "score_trace", "theta_trace"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
