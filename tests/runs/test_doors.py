"""One recording, several doors: `replay`, `gap` and `load` tell the same numbers of an arm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.effects.active import lasting_effects
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.robots import read_robot
from adapter.gap.load import find_load
from adapter.gap.workflow import find_gap
from adapter.judgement.posterior import Moments, Part, judge
from adapter.learning.known_effects import learnable
from adapter.learning.settings import LearnerSettings
from adapter.model.model_file import load_model
from adapter.model.self_model import SelfModel
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import Outcome, learned_model
from adapter.runs.pipeline import make_learner
from adapter.runs.replay import fitted_to, replay
from drivers.files.mcap import Log, read_log
from tests.helpers.arm_data import panda_model
from tests.helpers.twin_makers import by_pinocchio
from tests.hidden.record import write_files
from tests.hidden.trial import nominal_urdf
from tests.hidden.twins import draw_twin

Numbers = dict[tuple[str, int], tuple[float, float]]
SEED = 6200
DRY = "coulomb_friction", "bristle_friction"
N = 7


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Log, SelfModel, Path]:
    """A recording of a Panda with a load, the bare one, and its URDF."""
    twin, folder = draw_twin(SEED), tmp_path_factory.mktemp("twin")
    log, model, _ = write_files(by_pinocchio(twin), nominal_urdf(twin.nominal), {}, folder)
    return read_log(log), read_robot(str(model)), model


@pytest.fixture(scope="module")
def outcome(recorded: tuple[Log, SelfModel, Path]) -> Outcome:
    log, model, _ = recorded
    own, _ = fitted_to(log, PipelineSettings().filter)
    settings = PipelineSettings(filter=own, learner=LearnerSettings(effects=REAL_ARM_EFFECTS))
    return replay(log, model, settings).outcome


def numbers(model: SelfModel) -> Numbers:
    """Sizes of friction, offsets and motors by joint; dry friction of either kind as one."""
    found = {}
    for e in lasting_effects(model.effects, N):
        for key in {"Fc", "Fv", "o", "B"} & set(e.values):
            found[key, e.joint] = float(e.values[key]), float(e.std[key] or 0.0)
    return found


def test_friction_offsets_and_motors_agree(
    recorded: tuple[Log, SelfModel, Path], outcome: Outcome, tmp_path: Path
) -> None:
    log, model, file = recorded
    ours = numbers(learned_model(outcome, model))
    find_gap([log], str(file), model_out=tmp_path / "gap.json")
    theirs = numbers(load_model(tmp_path / "gap.json"))
    shared = sorted(set(ours) & set(theirs))
    assert len(shared) >= 2 * N
    apart = [(ours[k][0] - theirs[k][0]) / np.hypot(ours[k][1], theirs[k][1]) for k in shared]
    assert np.mean(np.abs(apart) < 2.0) > 0.85 and np.max(np.abs(apart)) < 4.0, apart


def test_the_load_agrees(recorded: tuple[Log, SelfModel, Path], outcome: Outcome) -> None:
    log, model, _ = recorded
    theirs, (theta, covariance) = find_load(log, model), outcome.held
    std = np.sqrt(covariance[0, 0])
    assert abs(theta[0] - theirs.mass) < 2.0 * np.hypot(std, theirs.mass_std)
    assert abs(theta[0] - draw_twin(SEED).load_kg) < 3.0 * std
    assert 0.02 < std < 0.4


def test_nothing_is_below_zero_that_cannot_be(outcome: Outcome) -> None:
    """And what is held at nothing is not called exactly nothing."""
    for name in ("viscous_friction", "bristle_friction", "motor_inertia"):
        k = REAL_ARM_EFFECTS.index(name)
        assert (outcome.effects[k] >= 0.0).all() and (outcome.effects_std[k] > 1e-4).all()


def test_what_cannot_be_negative_is_held_at_zero_with_its_doubt() -> None:
    """Two columns of one joint: what is left explains as much as it can alone."""
    rng = np.random.default_rng(3)
    x = rng.normal(size=(2000, 2))
    y = x @ [1.0, -0.2] + 0.1 * rng.normal(size=2000)
    squares, products = (x.T @ x)[None], (x.T @ y)[None]
    size, rows = np.array([y @ y]), np.array(2000.0)
    sums = squares, products, size, np.zeros(1), (x[:, None, :], y[:, None])
    part = Part(Moments(0.1, rows, *sums), np.arange(2), np.ones(1, dtype=bool), np.array([0.1]))
    std = np.ones(2)
    free = judge([part], std, np.zeros(2, dtype=bool))
    held = judge([part], std, np.array([False, True]))
    assert np.allclose(free.x, [1.0, -0.2], atol=0.02)
    alone = products[0, 0] / squares[0, 0, 0]
    assert held.x[1] == 0.0 and held.x[0] == pytest.approx(alone, rel=1e-3)
    assert 0.2 < np.sqrt(held.covariance[1, 1] / free.covariance[1, 1]) < 5.0


def test_a_spring_of_a_model_is_learned_further_as_spring_and_offset() -> None:
    spring = {"effect": "joint_spring", "joints": [4], "parameters": {"k": 0.3, "q0": -1.5}}
    model = replace(panda_model(), effects=(spring,))
    names = learnable(model, ())
    assert set(names) == {"joint_spring", "torque_offset"}
    learner = make_learner(model, PipelineSettings(learner=LearnerSettings(effects=names)))
    values = dict(zip(names, learner.theta.believed[0], strict=True))
    assert values["joint_spring"][3] == pytest.approx(0.3)
    assert values["torque_offset"][3] == pytest.approx(0.45)
    assert learner.known is None  # nothing of it is taken off the states beside
