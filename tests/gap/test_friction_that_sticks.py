"""Arms that stop and start: what rests say of friction, and what they don't."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from adapter.gap.result import GapResult
from adapter.gap.workflow import find_gap
from adapter.model.urdf import model_from_urdf
from adapter.screening.screen import refuse
from drivers.files.mcap import Log
from sim.effects import Effect
from tests.helpers.gap_mujoco import mujoco_recording
from tests.hidden.trial import Trial, draw, nominal_urdf

SEEDS, PLAY_RAD = (73000, 73001), 8e-3
BOTH_WAYS_S, MOVES = 0.5, 0.05  # that a joint must move each way, and how fast, rad/s


@cache
def judged(seed: int, *beside: Effect) -> tuple[Trial, Log, GapResult]:
    """An arm whose joints truly stick, from point to point, and what is said of it."""
    trial = draw(seed, "null", motion="points", sticks=True)
    trial = replace(trial, effects=(*trial.effects, *beside))
    log = mujoco_recording(trial)
    return trial, log, find_gap([log], model_from_urdf(nominal_urdf(trial.nominal)))


@pytest.mark.parametrize("seed", SEEDS)
def test_friction_of_each_joint_that_turned_both_ways_is_named_and_sized(seed: int) -> None:
    trial, log, result = judged(seed)
    hidden = {e.joints: e.number("Fc") for e in trial.effects}
    found = {f.joints: f for f in result.findings}
    ways = [1e-3 * np.sum(way * log.dq > MOVES, axis=0) for way in (1, -1)]
    turned = [(int(j) + 1,) for j in np.flatnonzero(np.min(ways, axis=0) > BOTH_WAYS_S)]
    assert len(turned) > 2
    for joints in turned:
        f, Fc = found[joints], hidden[joints]
        assert f.effect == "coulomb_friction"
        assert abs(f.parameters["Fc"] - Fc) < max(0.1 * Fc, 4.0 * f.std["Fc"])
    assert not result.unexplained
    assert {f.effect for f in result.findings} == {"coulomb_friction"}


def test_play_that_is_crossed_a_few_times_is_named_beside_it() -> None:
    """As noise it hides itself: the joint's residual is mostly what the crossings make."""
    _, _, result = judged(SEEDS[1], Effect("backlash", (4,), {"b": PLAY_RAD}))
    play = next(f for f in result.findings if f.effect == "backlash")
    assert play.joints == (4,) and abs(play.parameters["b"] - PLAY_RAD) < 0.1 * PLAY_RAD
    assert {f.effect for f in result.findings} == {"coulomb_friction", "backlash"}


def test_a_slow_low_pass_of_one_joint_is_named_beside_it() -> None:
    """Of 5 Hz: sought as one of 3 ms it was told as a delay, as one of 15 Hz still may be."""
    slow = Effect("torque_filter", (4,), {"d": 0.03, "c": 8.1e-4})
    _, _, result = judged(SEEDS[1], slow)
    assert ("torque_filter", (4,)) in {(f.effect, f.joints) for f in result.findings}
    assert {f.effect for f in result.findings} == {"coulomb_friction", "torque_filter"}


def test_a_late_torque_sensor_of_one_joint_is_no_coupled_axis() -> None:
    """Friction that holds through rests, late: as sign(dq) a reading of joints 6 and 7 together."""
    trial = draw(53008, "single", motion="points", sticks=True)
    screened = refuse(mujoco_recording(trial), model_from_urdf(nominal_urdf(trial.nominal)))
    assert trial.effects[0].name == "torque_filter" and screened.torque.late_s == 0.0


def test_what_would_not_have_been_seen_is_told_of_all_joints_that_move() -> None:
    """The smallest friction that is named grows with a joint's noise, and is told in N m."""
    _, _, result = judged(SEEDS[0])
    told = {(x.effect, x.joint): x for x in result.unseen}
    assert told["signal_delay", 0].unit == "s" and 5e-4 < told["signal_delay", 0].size < 0.05
    assert told["joint_elasticity", 2].above and not told["torque_gain", 2].above
    assert ("coulomb_friction", 2) not in told or result.findings[0].joints != (2,)
    assert result.as_dict()["unseen"][0]["size"] > 0.0
