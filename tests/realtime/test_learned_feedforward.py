"""Feed-forward from a published estimate: when it counts, and what it then is."""

from dataclasses import replace

import numpy as np
import pytest

from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.model.robots import documented
from adapter.realtime.following import FeedforwardBound, LearnedFeedforward
from adapter.realtime.session import run_lockstep
from adapter.realtime.snapshot import SnapshotError, SnapshotWriter
from adapter.signals.front_end import FrontEnd
from drivers.interface import JointSample
from sim.plant import SimulatedArm
from sim.scenarios import build
from tests.helpers.live_learners import nothing_known

PANDA = documented("panda")
N = PANDA.tree.n
Q, DQ, DDQ = (scale * np.sin(np.arange(N) + 0.3) for scale in (0.8, 0.5, 2.0))
TOOL = np.array([0.5, 0.0, 0.01, 0.02, 0.003, 0.003, 0.002, 0.0, 0.0, 0.0])


@pytest.fixture
def board():
    writer = SnapshotWriter.create(PANDA.tree.joint_names, name=None)
    yield writer
    writer.close()
    writer.unlink()


def estimate(theta=None, **converged):
    """What a learner publishes: the documented arm, or another θ."""
    known = nothing_known(N, N, 0)
    theta = PANDA.theta if theta is None else theta
    return replace(known, lam=PANDA.lam, theta=theta, **converged)


DONE = {"lam_converged": True, "theta_converged": True}


@pytest.mark.parametrize(
    "early",
    [{}, {"lam_converged": True}, {"theta_converged": True}],
    ids=["nothing", "lambda", "theta"],
)
def test_it_is_ready_once_both_parts_have_converged(board, early):
    forward = LearnedFeedforward(PANDA.tree, PANDA.gravity)
    forward.refresh()
    assert not forward.ready
    forward.attach(board.name)
    board.publish(estimate(**early))
    forward.refresh()
    assert not forward.ready
    board.publish(estimate(**DONE))
    forward.refresh()
    assert forward.ready
    expected = ModelFeedforward.of(PANDA)(Q, DQ, DDQ)
    np.testing.assert_allclose(forward(Q, DQ, DDQ), expected, rtol=1e-12)
    board.publish(estimate(2.0 * PANDA.theta, **early))  # doubted again: the last good one stays
    forward.refresh()
    np.testing.assert_allclose(forward(Q, DQ, DDQ), expected, rtol=1e-12)
    forward.detach()
    assert forward.ready


def test_a_known_tool_comes_on_top_of_what_is_learned(board):
    forward = LearnedFeedforward(PANDA.tree, PANDA.gravity, tool_theta=TOOL)
    forward.attach(board.name)
    board.publish(estimate(**DONE))
    forward.refresh()
    whole = PANDA.theta.copy()
    whole[-1] += TOOL
    expected = ModelFeedforward.of(replace(PANDA, theta=whole))(Q, DQ, DDQ)
    np.testing.assert_allclose(forward(Q, DQ, DDQ), expected, rtol=1e-12)
    forward.detach()


def test_an_estimate_that_is_no_number_leaves_the_last(board):
    forward = LearnedFeedforward(PANDA.tree, PANDA.gravity)
    forward.attach(board.name)
    broken = PANDA.theta.copy()
    broken[2, 3] = np.nan
    board.publish(estimate(broken, **DONE))
    forward.refresh()
    assert not forward.ready
    board.publish(estimate(**DONE))
    forward.refresh()
    before = forward(Q, DQ, DDQ)
    board.publish(estimate(broken, **DONE))
    forward.refresh()
    assert np.array_equal(forward(Q, DQ, DDQ), before)
    forward.detach()


def test_nobody_publishes():
    with pytest.raises(SnapshotError, match="no estimate is published"):
        LearnedFeedforward(PANDA.tree, PANDA.gravity).attach("nobody_at_all")


def bounded() -> LearnedFeedforward:
    bound = FeedforwardBound(PANDA, ModelFeedforward.of(PANDA))
    return LearnedFeedforward(PANDA.tree, PANDA.gravity, bound=bound)


def follow(forward: LearnedFeedforward, calls: int) -> np.ndarray:
    """What it says of one motion in so many ticks (calls, n), refreshed as the controller does."""
    said = []
    for k in range(calls):
        if k % 50 == 0:
            forward.refresh()
        said.append(forward(Q.copy(), DQ, DDQ))
    return np.array(said)


def loaded(mass: float, std: float = 0.0):
    theta = PANDA.theta.copy()
    theta[-1, 0] += mass
    return replace(estimate(theta, **DONE), theta_std=np.full((N, 10), std))


def test_every_update_fades_in(board):
    forward = bounded()
    forward.attach(board.name)
    board.publish(loaded(0.0))
    before = follow(forward, 100)[-1]
    board.publish(loaded(2.0))
    said = follow(forward, 700)
    steps = np.abs(np.diff(np.vstack([before, said]), axis=0))
    whole = np.abs(said[-1] - before)
    assert (steps.max(axis=0) <= whole / 400 + 1e-9).all() and whole.max() > 5.0
    expected = ModelFeedforward.of(replace(PANDA, theta=loaded(2.0).theta))(Q, DQ, DDQ)
    np.testing.assert_allclose(said[-1], expected, atol=1e-9)
    assert not forward.notes
    forward.detach()


@pytest.mark.parametrize("std", [0.0, 1e3], ids=["sure of itself", "without any idea"])
def test_a_false_load_falls_back_to_the_documented_model_and_says_so(board, std):
    forward = bounded()
    forward.attach(board.name)
    board.publish(loaded(0.0))
    follow(forward, 100)
    board.publish(loaded(20.0, std))
    documented = ModelFeedforward.of(PANDA)(Q, DQ, DDQ)
    most = FeedforwardBound(PANDA, ModelFeedforward.of(PANDA)).at(Q, DQ, DDQ, np.full((N, 10), std))
    said = follow(forward, 1200)
    assert (np.abs(said - documented) <= most + 1e-9).all()
    assert np.abs(np.diff(said, axis=0)).max() < 0.6  # below the torque rate
    np.testing.assert_allclose(said[-1], documented, atol=1e-9)
    assert len(forward.notes) == 1 and "fell back to the documented model" in forward.notes[0]
    board.publish(loaded(1.0))  # believed again
    assert np.abs(follow(forward, 1200)[-1] - documented).max() > 1.0
    assert len(forward.notes) == 1
    forward.detach()


def test_the_bound_is_set_by_a_load_friction_and_the_standard_deviation():
    bound = FeedforwardBound(PANDA, ModelFeedforward.of(PANDA))
    sure, unsure, lost = (bound.at(Q, DQ, DDQ, np.full((N, 10), x)) for x in (0.0, 0.1, 1e3))
    assert (sure > 0.1 * PANDA.limits.effort).all()
    assert (unsure >= sure).all() and unsure.max() > sure.max()
    np.testing.assert_allclose(lost, 2.0 * sure)


def test_a_false_load_in_a_motion_stays_within_the_bound_and_the_motion_goes_on(board) -> None:
    """20 kg too many are published while an embedded arm moves by what was learned before."""
    limits, documented_model = MotionLimits.of(PANDA), ModelFeedforward.of(PANDA)
    bound, forward = FeedforwardBound(PANDA, ModelFeedforward.of(PANDA)), bounded()
    none = np.zeros((N, 10))
    board.publish(loaded(0.0))
    forward.attach(board.name)
    controller = ExcitationController(limits, None, None, forward, expected=documented_model)
    gains, ticks, beyond, share = ControlSettings().gains(limits), 0, 0.0, 0.0

    def note(sample: JointSample, tau: np.ndarray | None) -> None:
        nonlocal ticks, beyond, share
        ticks += 1
        if ticks == 1500:
            board.publish(loaded(20.0))
        ref = controller.reference
        if ticks < 1200 or tau is None or ref is None:
            return
        fed_back = gains[0] * (ref.q - sample.q) + gains[1] * (ref.dq - sample.dq)
        model = documented_model(ref.q, ref.dq, ref.ddq)
        apart = np.abs(tau - fed_back - model) - bound.at(ref.q, ref.dq, ref.ddq, none)
        beyond, share = max(beyond, apart.max()), max(share, np.abs(tau / limits.effort).max())

    arm = SimulatedArm(build("nominal", 1).plant())
    try:
        result = run_lockstep(arm, FrontEnd(PANDA), None, controller, 3.0, each=note)
    finally:
        arm.close()
        controller.detach()
    assert result.fault is None and result.tracking is not None
    assert "fell back" in result.tracking["notes"][0]
    assert result.samples > 3000 and share < 1.0
    assert beyond < 1.0
