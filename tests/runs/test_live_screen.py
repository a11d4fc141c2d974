"""The first seconds of a live arm's motion judge its torques; before that nothing has converged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.realtime.session import run_lockstep
from adapter.report.trust import headline
from adapter.report.worth import Worth
from adapter.runs import live
from adapter.runs.config import PipelineSettings
from adapter.runs.live import FIRST_S
from adapter.runs.pipeline import make_front_end
from adapter.runs.run_folder import run_data
from adapter.runs.score import Course, figures, reference_from
from sim.plant import SimulatedArm
from sim.scenarios import build
from tests.helpers.live_tools import PANDA, parts

EVERY = 50  # states between two published estimates


class OtherSign(SimulatedArm):
    """The simulated arm behind a driver that tells the torque of joint 4 the other way."""

    def read(self):
        sample = super().read()
        return replace(sample, tau=sample.tau * [1, 1, 1, -1, 1, 1, 1])


@pytest.mark.parametrize("driver", [OtherSign, SimulatedArm])
def test_the_verdict_comes_first(driver, capsys, tmp_path) -> None:
    settings = PipelineSettings()
    learner = live.single_thread_learner(PANDA, settings, None, aloud=True)
    front_end, publish, seen = make_front_end(PANDA, settings), live.Publisher(), []

    class Published:
        def step(self, state) -> None:
            learner.step(state)
            if learner.learned % EVERY == 0:
                shown = publish(learner)
                seen.append((shown.lam_converged, shown.theta_converged, learner.verdict))

    run_lockstep(driver(build("nominal", 5).plant()), front_end, Published(), parts()[1], 6.0)
    first = int(1e3 * FIRST_S / EVERY)
    assert [verdict.judged for *_, verdict in seen].index(True) in (first - 1, first)
    assert not any(lam or theta for lam, theta, verdict in seen if not verdict.good)
    outcome, told = live.collect_judged(learner), capsys.readouterr().err
    times, known = (front_end.first_moving_ns, front_end.delay_s), reference_from(None, PANDA)
    numbers = figures(outcome, PANDA, known, Course(7000, {}, *times))
    data = run_data(outcome, PANDA, numbers, known, first_moving_ns=times[0], delay_s=times[1])
    said = headline(data, Worth.of(data))[0]
    converged = [numbers[name]["converged_s"] is not None for name in ("lambda", "theta")]
    if driver is SimulatedArm:
        assert seen[-1][0] and all(converged) and told == ""
        assert numbers["lambda"]["converged_s"] < 2.0 and "The learned model" in said
        return
    assert told.startswith("warning: live: the torque of panda_joint4 has the wrong sign")
    assert told.count("\n") == 1 and "panda_joint4 has the wrong sign" in said
    assert not seen[-1][0] and not any(converged)
    np.testing.assert_array_equal(data.model.theta, PANDA.theta)
    assert data.model.provenance["refusal"] == numbers["torques"]["refusal"]
    live.keep_learner(learner, tmp_path)
    heir = live.single_thread_learner(PANDA, settings, None)
    live.restore_learner(heir, tmp_path)
    assert heir.screen.judge() == learner.verdict
