"""A run that stops and goes on equals one that never stopped."""

from pathlib import Path

import numpy as np
import pytest

from adapter.errors import SettingsError
from adapter.learning.checkpoint import load_checkpoint, save_checkpoint
from adapter.learning.learner import OnlineLearner
from tests.helpers.arm_data import Motion, arm, learner_for, record, states_of, teach

EFFECTS = ("viscous_friction", "coulomb_friction")


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    return states_of(record(arm(), Motion(3.0, seed=4)))


@pytest.fixture(scope="module")
def whole(states) -> OnlineLearner:
    """What never stopped."""
    return teach(learner_for(effects=EFFECTS), states, rows=1)


@pytest.mark.parametrize("cut", [200, 1000, 2500])
def test_resumed_equals_uninterrupted_bit_for_bit(tmp_path: Path, states, whole, cut: int) -> None:
    first, second = (learner_for(effects=EFFECTS) for _ in range(2))
    save_checkpoint(teach(first, states[:cut], rows=1), tmp_path / "c.npz")
    load_checkpoint(second, tmp_path / "c.npz")
    teach(second, states[cut:], rows=1)
    assert np.array_equal(whole.schema.lam, second.schema.lam)
    assert np.array_equal(whole.theta.th, second.theta.th)
    assert np.array_equal(whole.theta.moments.A, second.theta.moments.A)
    assert np.array_equal(whole.score_trace.rows, second.score_trace.rows)
    assert whole.learned == second.learned and whole.rebuilds == second.rebuilds
    assert whole.theta_started_ns == second.theta_started_ns is not None


def test_another_robot_or_other_settings_are_refused(tmp_path: Path, states) -> None:
    learner = learner_for()
    learner.step(states[0])
    save_checkpoint(learner, tmp_path / "c.npz")
    with pytest.raises(SettingsError, match="other learner settings"):
        load_checkpoint(learner_for(seed=7), tmp_path / "c.npz")


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"PK\x03\x04broken"])
def test_what_is_no_checkpoint_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.npz"
    with pytest.raises(SettingsError, match=r"c\.npz"):
        load_checkpoint(learner_for(), path)  # it is not there yet
    path.write_bytes(content)
    with pytest.raises(SettingsError, match="cannot be read as a checkpoint"):
        load_checkpoint(learner_for(), path)


def test_replaced_in_one_go(tmp_path: Path, states) -> None:
    learner = learner_for()
    for state in states[:50]:
        learner.step(state)
        save_checkpoint(learner, tmp_path / "c.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["c.npz"]
