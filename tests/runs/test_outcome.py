"""λ as it leaves the house: what no data showed is the documentation's; when it had settled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from adapter.effects.robots import robot_urdf
from adapter.learning.learner import OnlineLearner
from adapter.model.model_file import dumps, loads
from adapter.model.spatial import matrix_from_zxz, rot_z, zxz_from_matrix
from adapter.physics.freedom import Freedom
from adapter.physics.identifiability import random_motion
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.outcome import collect, completed_lambda, frame_errors, learned_model
from adapter.runs.score import (
    Course,
    Reference,
    counted_from,
    figures,
    reference_from,
    schema_score,
    settled_at,
    trailing_rms,
)
from sim.scenarios import build
from tests.helpers.arm_data import Motion, arm, learner_for, panda_model, record, states_of, teach


def taught(kind: str, seed: int) -> OnlineLearner:
    truth = arm() if kind == "synthesized" else build("bent_link", seed).truth
    data = record(truth, Motion(4.0, seed), links=kind == "measured")
    return teach(learner_for(seed=seed), states_of(data))


def places(text: str, q: np.ndarray) -> np.ndarray:
    """Every joint's frame (n, 4, 4) in the base, by Pinocchio."""
    model = pin.buildModelFromXML(text)
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    return np.array([data.oMi[k].homogeneous for k in range(1, model.njoints)])


def test_the_exported_arm_stands_where_the_documented_one_does() -> None:
    documented = panda_model()
    model = learned_model(collect(taught("synthesized", 0)), documented)
    for q in random_motion(documented.tree, 5, 1).q:
        ours, theirs = (places(robot_urdf(x, alone=True).text, q) for x in (model, documented))
        assert np.abs(ours - theirs).max() < 1e-6
    filled = loads(dumps(model)).provenance["lambda_filled"]
    assert [text.split(":")[0] for text in filled] == ["panda_joint1", "panda_joint2"]


def test_a_finite_motion_costs_no_torque_and_counts_as_no_error() -> None:
    """Joint 2 documented 86 degrees further about joint 1's axis, as on a UR."""
    documented, outcome = panda_model(), collect(taught("synthesized", 1))
    far = documented.lam.copy()
    far[1, :3] = zxz_from_matrix(rot_z(1.5) @ matrix_from_zxz(far[1:2, :3]))[0]
    far[1, 5] += 0.3
    elsewhere = replace(documented, lam=far)
    lam = completed_lambda(outcome, elsewhere)[0]
    np.testing.assert_allclose(lam, far, atol=1e-7)
    motion = random_motion(documented.tree, 20, 2)
    before, after = (
        RigidArm.of(replace(documented, lam=x)).torque(*motion) for x in (outcome.lam, lam)
    )
    assert np.abs(after - before).max() < 1e-3  # N m, of 80; λ itself is learned to 1e-6
    score = schema_score(outcome, elsewhere, Reference(documented.lam, None, "there"), 0.0)
    assert max(score["rotation_error_rad"]) < 1e-6 and max(score["position_error_m"]) < 1e-6
    assert score["converged_s"] is not None and len(score["filled"]) == 2


@pytest.mark.parametrize("seed", range(2))
def test_measured_frames_keep_what_the_data_show(seed: int) -> None:
    documented, learner = panda_model(), taught("measured", seed)
    outcome = collect(learner)
    lam = completed_lambda(outcome, documented)[0]
    np.testing.assert_allclose(lam[0, 3:], documented.lam[0, 3:], atol=1e-9)
    seen = build("bent_link", seed).truth.lam
    hidden = np.einsum("jaa->j", np.eye(6) - outcome.lam_identifiable)
    # how joint 2 is turned about joint 1's axis shows by a base that leans by 2 degrees alone
    assert np.abs(hidden - [4, 2, 0, 0, 0, 0, 0]).max() < 1e-6
    turn, shift = (x[2:] for x in frame_errors(lam, seen, Freedom.none(7)))
    std = np.sqrt(np.einsum("jaa->ja", outcome.lam_covariance))[2:]
    assert (turn < 5.0 * np.linalg.norm(std[:, :3], axis=1)).all()
    assert (shift < 5.0 * np.linalg.norm(std[:, 3:], axis=1)).all()


def test_theta_leaves_the_house_with_the_documented_weights_and_the_learned_torques() -> None:
    documented, outcome = panda_model(), collect(taught("synthesized", 0))
    model = learned_model(outcome, documented)
    arm = RigidArm.of(model)
    seen = np.split(outcome.score_trace[:, 1:22], 3, axis=1)
    learned = arm.changed(theta=outcome.theta)
    assert np.abs(arm.torque(*seen) - learned.torque(*seen)).max() < 0.02  # N m, of 80
    assert model.theta[0, 0] == pytest.approx(
        documented.theta[0, 0], rel=0.05
    )  # no torque shows it
    assert (model.theta[:, 0] > 0.05 * documented.theta[:, 0]).all()
    back = loads(dumps(model)).provenance
    assert back["theta_source"] == "learned" and back["theta_filled"][0] == "panda_link1: all"
    none = learned_model(replace(outcome, theta_started_ns=None), documented)
    np.testing.assert_array_equal(none.theta, documented.theta)
    assert none.provenance["theta_source"] == "documentation: λ had not converged"


@pytest.mark.parametrize(
    ("good", "at"),
    [
        ("1111", 0.0),
        ("0111", 0.1),
        ("0101", 0.3),  # it was good once before
        ("1101", 0.3),
        ("1110", None),
        ("0000", None),
        ("", None),
    ],
)
def test_settled_is_what_stays_good_to_the_end(good: str, at: float | None) -> None:
    times = 0.1 * np.arange(len(good))
    found = settled_at(times, np.array([c == "1" for c in good], dtype=bool))
    assert found is None if at is None else found == pytest.approx(at)


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
