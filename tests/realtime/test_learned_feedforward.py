"""Feed-forward from a published estimate: when it counts, and what it then is."""

from dataclasses import replace

import numpy as np
import pytest

from adapter.control.feedforward import ModelFeedforward
from adapter.model.robots import documented
from adapter.realtime.learned_feedforward import LearnedFeedforward
from adapter.realtime.snapshot import SnapshotError, SnapshotWriter, nothing_known

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
