"""The generator of hidden-effect trials: seeds, no leaks, three simulators agree.

Twins of real logs keep the limits, carry their load and are the same every time.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from adapter.model.model_file import save_model
from adapter.model.robots import documented
from adapter.model.urdf import read_urdf
from drivers.files.mcap import Commands, read_log
from tests.benchmarks.gap_trials import run_trial
from tests.helpers import gap_mujoco
from tests.helpers.gap_effects import predict, sense, slope
from tests.helpers.gap_oracle import Oracle, detectability, rms, second, slow, torque_judge
from tests.helpers.gap_scorer import score_trial, summary, table
from tests.helpers.gap_tools import pinocchio_recording, with_sines
from tests.helpers.twin_makers import by_mujoco, by_pinocchio
from tests.hidden import draw, motion
from tests.hidden.record import simulate, write
from tests.hidden.sizes import CATALOGUE, OUTSIDE
from tests.hidden.twins import STEP_S, draw_twin

SEEDS = range(150)


@pytest.fixture(scope="module")
def trials():
    return [draw(seed) for seed in SEEDS]


def test_a_seed_decides_everything():
    drawn = [draw(seed, "single") for seed in (5, 5, 6)]
    first, again, other = map(pinocchio_recording, drawn)
    assert drawn[0].as_dict() == drawn[1].as_dict() != drawn[2].as_dict()
    assert all(
        np.array_equal(getattr(first, key), getattr(again, key))
        for key in ("stamp_ns", "q", "dq", "tau")
    )
    assert not np.array_equal(first.q, other.q)


def test_motions_keep_the_limits(trials):
    assert {t.motion.kind for t in trials} == set(motion.KINDS)
    for trial in trials[:40]:
        q, dq, ddq = trial.motion.at(trial.times[::20])
        limits = trial.arm.limits
        assert np.all((q > limits.lower) & (q < limits.upper))
        assert np.all(np.abs(dq) < limits.velocity) and np.all(np.abs(ddq) < limits.acceleration)
        assert np.allclose(q[0], trial.motion.middle) and np.allclose(dq[0], 0, atol=1e-6)


def test_recording_tells_nothing_but_what_was_measured(tmp_path):
    trial = next(t for t in map(draw, SEEDS) if t.kind == "single" and t.commands)
    orders = Commands(np.arange(20000) * 10**6, np.zeros((20000, 7)))
    recording = replace(pinocchio_recording(trial), commands=orders)
    log, model, truth = write(trial, tmp_path, recording, "pinocchio")
    data = log.read_bytes() + model.read_bytes()
    read = read_log(log)
    assert read.attachments == {} and set(read.metadata) == {"joint_names", "link_names"}
    assert read.commands is not None and set(read.topics) == {"/joint_states", "/joint_commands"}
    assert not any(name.encode() in data for name in (*CATALOGUE, *OUTSIDE, "truth", "seed"))
    nominal = read_urdf(model)
    assert np.allclose(nominal.theta, trial.nominal.theta, atol=1e-12)
    assert not np.allclose(nominal.theta, trial.arm.theta, rtol=1e-3)
    told = json.loads(truth.read_text())
    assert told["effects"] == [e.as_dict() for e in trial.effects]


@pytest.mark.parametrize(
    ("name", "seed", "tolerance"),
    [
        ("coulomb_friction", 24, 0.15),  # a joint that sticks takes any torque up to Fc
        ("motor_inertia", 12, 0.02),
        ("encoder_offset", 15, 0.02),
        ("external_wrench", 16, 0.02),
        ("payload", 17, 0.02),
    ],
)
def test_simulators_agree_on_the_signature_of_an_effect(name, seed, tolerance):
    """Torque beside that of the arm without the effect, on the motion that was read."""
    trial = replace(with_sines(draw(seed, "single", name, rubs=False)), seconds=5.0)
    (effect,) = trial.effects
    late = (
        None if effect.interval_s is None else (3.0, None if effect.interval_s[1] is None else 4.0)
    )
    trial = replace(trial, effects=(replace(effect, interval_s=late),))
    t = trial.times
    motions = [part[:3] for part in (simulate(trial), gap_mujoco.simulate(trial))]
    motions.append(sense(trial.arm, trial.effects, t, *trial.motion.at(t)))
    for i, (q, dq, tau) in enumerate(motions):
        torque = tau - (trial.disturbance() if i < 2 else 0.0)
        ddq = slope(t, dq)
        without = predict(trial.arm, (), t, q, dq, ddq, tau)
        expected = predict(trial.arm, trial.effects, t, q, dq, ddq, tau) - without
        error, size = rms(slow(torque - without - expected)), rms(slow(expected))
        assert error.max() < tolerance * size.max() + 2e-3, (i, error, size)


def test_oracle_sees_what_can_be_seen():
    strong = with_sines(draw(3, "single", "coulomb_friction"))
    weak = draw(1, "single", "encoder_offset", rubs=False)
    weak = replace(weak, effects=(replace(weak.effects[0], joints=(1,)),))
    assert detectability(strong)[0] > 20.0
    assert detectability(weak)[0] < 1.0  # gravity does not change with joint 1
    fit = Oracle(strong, pinocchio_recording(strong)).fit()
    truth, found = strong.effects[0].number("Fc"), fit.effects[0].number("Fc")
    assert abs(found - truth) < 0.05 * truth
    joint = strong.effects[0].joints[0] - 1
    assert fit.held_rmse_nm[joint] < 0.5 * fit.before_rmse_nm[joint]
    other = second(strong)
    assert other.effects == strong.effects and np.array_equal(other.arm.theta, strong.arm.theta)
    assert not np.allclose(other.motion.middle, strong.motion.middle)


def _peeking(trial):
    """A workflow that knows the trial, and says so as `adapter gap` would."""
    findings = [{**effect.as_dict(), "evidence": 1.0} for effect in trial.effects]
    return lambda logs, model, **more: {"findings": findings, "unexplained": []}


def test_trials_run_and_score():
    trials = draw(1, "null"), draw(3, "single", "coulomb_friction")
    rows = [run_trial(trial, "pinocchio", _peeking(trial)) for trial in trials]
    figures = summary(rows)
    assert figures["shares"]["null_false"][3:] == [0, 1]
    assert figures["shares"]["single_exact"][3:] == [1, 1]
    assert "coulomb_friction" in table(figures)


def test_judge_compares_with_the_oracle_on_another_motion(tmp_path):
    """The true effect on the nominal arm: worse than the oracle, far better than no effect."""
    trial = draw(3, "single", "coulomb_friction")
    recording = pinocchio_recording(trial)
    save_model(documented("panda"), tmp_path / "out.json")
    named = {"findings": [e.as_dict() for e in trial.effects], "model_out": "out.json"}
    ratios = [
        torque_judge(trial, recording, result, tmp_path)["torque_ratio"]
        for result in (named, {**named, "findings": []})
    ]
    assert 1.0 < ratios[0] < ratios[1]
    assert torque_judge(trial, recording, {"findings": []}, tmp_path) == {}


def told(effect, joints=(), interval_s=None, **parameters):
    entry = {"effect": effect, "joints": list(joints), "parameters": parameters}
    return {**entry, "interval_s": interval_s, "evidence": 0.97}


def test_scorer_tells_right_from_wrong():
    load = told("payload", (), [7.0, None], m=1.0, cx=0.0, cy=0.0, cz=0.2)
    truth = {"seed": 0, "kind": "single", "effects": [load]}
    right = told("payload", (), [7.2, None], m=1.05, cx=0.01, cy=0.0, cz=0.2)
    row = score_trial({"findings": [right]}, truth, [50.0])
    assert row["exact"] and row["parameters"] == [True] and np.isclose(row["date_errors_s"][0], 0.2)
    heavy = {**right, "parameters": {**right["parameters"], "m": 1.3}, "std": {"m": 0.05}}
    assert score_trial({"findings": [heavy]}, truth, [50.0])["parameters"] == [False]
    body = told("link_inertia", [7])
    assert score_trial({"findings": [body]}, truth, [50.0])["wrong"] == ["link_inertia"]
    listed = {**body, "ambiguous_with": ["payload"]}
    row = score_trial({"findings": [listed]}, truth, [50.0])
    assert row["named"] == 1 and not row["exact"] and not row["wrong"]
    extra = told("coulomb_friction", [2], Fc=1.0)
    row = score_trial({"findings": [right, extra]}, truth, [50.0])
    assert not row["exact"] and row["sure_wrong"] == 1
    outside = {**truth, "kind": "outside"}
    row = score_trial({"findings": [right], "unexplained": [{"joint": 1}]}, outside, [50.0])
    assert row["unexplained"] and row["sure_wrong"] == 1


def test_twins_keep_the_limits_and_repeat():
    twins, again = [draw_twin(seed) for seed in range(60)], draw_twin(7)
    assert {twin.kind for twin in twins} == {"points", "sines", "hand"}
    assert (again.q == twins[7].q).all() and (again.arm.theta == twins[7].arm.theta).all()
    limits = again.nominal.limits
    for twin in twins:
        assert (twin.q > limits.lower).all() and (twin.q < limits.upper).all()
        assert (np.abs(twin.motion[1]) < limits.velocity).all()


@pytest.mark.parametrize("seed", [0, 5])
def test_both_simulators_make_the_same_log(seed):
    """Up to how well a controller follows, the torque of the drawn motion."""
    twin = draw_twin(seed)
    ours, theirs = by_pinocchio(twin), by_mujoco(twin)
    assert (ours.stamp_ns == theirs.stamp_ns).all()
    np.testing.assert_allclose(theirs.q, ours.q, atol=0.05)
    off = np.sqrt(np.square(theirs.tau - ours.tau).mean(axis=0))
    assert (off < 0.25 * np.abs(ours.tau).max(axis=0) + 0.3).all()


def test_bristles_hold_and_slide():
    twin = draw_twin(3)
    friction = twin.friction
    slide = np.full((1000, 7), 0.3)
    torque = friction.along(slide, STEP_S)[-1]
    drop = (friction.stiction - friction.coulomb) * np.exp(-np.square(0.3 / friction.speed))
    np.testing.assert_allclose(torque, friction.coulomb + drop + 0.3 * friction.viscous, rtol=1e-6)
    held = friction.along(np.zeros((5, 7)), STEP_S)
    np.testing.assert_allclose(held, np.tile(friction.start * friction.coulomb, (5, 1)))
