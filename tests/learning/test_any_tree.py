"""λ of trees as CAD draws them, from starts at which ADAM alone stands in wrong valleys."""

from __future__ import annotations

import numpy as np
import pytest

from adapter.learning.frame_fit import Frame, best_frame, channel_costs, profiled_weights
from adapter.model.spatial import exp_rotation, rot_x
from tests.benchmarks.lambda_trials import learn, states_of
from tests.helpers.arm_data import learner_for
from tests.helpers.random_trees import cad_tree


@pytest.mark.parametrize("number", [2, 7, 107])
def test_a_tree_is_learned_in_time_and_nothing_wrong_is_said(number: int) -> None:
    found = learn(cad_tree(number), seed=0)
    assert found["restarts"] > 0  # ADAM alone fails here
    assert not found["failed"], found


def test_a_frame_half_a_turn_away_is_noticed_and_counted() -> None:
    """Half a turn from the truth the gradient vanishes: a saddle point."""
    model = cad_tree(3, joints=3)
    learner = learner_for(model)
    schema = learner.schema
    states = states_of(model, 2.5, 1)
    for state in states[:-600]:
        learner.learn_schema(state[None])
    before = schema.check.restarts
    assert schema.converged
    good = Frame(schema.R0[2].copy(), schema.p[2].copy())
    schema.R0[2] = schema.R0[2] @ rot_x(np.pi)
    for state in states[-600:]:
        learner.learn_schema(state[None])
    assert schema.check.restarts == before + 1 and not schema.started_anew
    assert np.allclose(schema.R0[2], good.R0, atol=1e-5) and np.allclose(
        schema.p[2], good.p, atol=1e-5
    )


def test_the_closed_form_needs_no_start() -> None:
    model = cad_tree(5, joints=8)
    schema = learner_for(model).schema
    schema.absorb(states_of(model, 2.0, 2))
    off = Frame(exp_rotation([2.0, -1.0, 0.5]), np.ones(3))
    for sums in schema.moments.M:
        found, _ = best_frame(sums, profiled_weights(sums, schema.count, off), off)
        power = np.trace(sums[:, :3, :3], axis1=1, axis2=2)
        assert (channel_costs(sums, found) <= 1e-10 * power).all()
