"""The first seconds of a live arm's motion judge its torques; before that nothing has converged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adapter.realtime.session import run_lockstep
from adapter.report.headline import Worth, headline
from adapter.runs import live
from adapter.runs.config import PipelineSettings
from adapter.runs.live_screen import FIRST_S
from adapter.runs.pipeline import make_front_end
from adapter.runs.run_folder import run_data
from adapter.runs.score import Course, figures, reference_from
from drivers.pybullet_arm import PyBulletArm
from sim.scenarios import build
from tests.helpers.live_tools import PANDA, parts

EVERY = 50  # states between two published estimates


class OtherSign(PyBulletArm):
    """The simulated arm behind a driver that tells the torque of joint 4 the other way."""

    def read(self):
        sample = super().read()
        return replace(sample, tau=sample.tau * [1, 1, 1, -1, 1, 1, 1])


@pytest.mark.parametrize("driver", [OtherSign, PyBulletArm])
def test_the_verdict_comes_first(driver, capsys, tmp_path) -> None:
    settings = PipelineSettings()
    learner = live.single_thread_learner(PANDA, settings, None, aloud=True)
    front_end, publish, seen = make_front_end(PANDA, settings), live.Publisher(), []

    class Published:
        def step(self, state) -> None:
            learner.step(state)
            if learner.learned % EVERY == 0:
                said = publish(learner)
                seen.append((said.lam_converged, said.theta_converged, learner.verdict))

    run_lockstep(driver(build("nominal", 5).plant()), front_end, Published(), parts()[1], 6.0)
    early = seen[: int(1e3 * FIRST_S / EVERY) - 1]
    assert not any(lam or theta or verdict.judged for lam, theta, verdict in early)
    assert seen[len(early) + 1][2].judged
    outcome, told = live.collect_judged(learner), capsys.readouterr().err
    course = Course(7000, {}, front_end.first_moving_ns, front_end.delay_s)
    reference = reference_from(None, PANDA)
    numbers = figures(outcome, PANDA, reference, course)
    times = {"delay_s": front_end.delay_s, "first_moving_ns": front_end.first_moving_ns}
    data = run_data(outcome, PANDA, numbers, reference, **times)
    first = headline(data, Worth.of(data))[0]
    converged = [numbers[name]["converged_s"] is not None for name in ("lambda", "theta")]
    if driver is PyBulletArm:
        assert seen[-1][0] and all(converged) and told == ""
        assert numbers["lambda"]["converged_s"] < 2.0 and "The learned model" in first
        return
    assert told.startswith("warning: live: the torque of panda_joint4 has the wrong sign")
    assert told.count("\n") == 1 and "panda_joint4 has the wrong sign" in first
    assert not any(lam or theta for lam, theta, _ in seen) and not any(converged)
    np.testing.assert_array_equal(data.model.theta, PANDA.theta)
    assert data.model.provenance["refusal"] == numbers["torques"]["refusal"]
    live.keep_learner(learner, tmp_path)
    heir = live.single_thread_learner(PANDA, settings, None)
    live.restore_learner(heir, tmp_path)
    assert heir.verdict == learner.verdict
