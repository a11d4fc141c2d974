"""Many steps in one call leave what as many steps one by one leave, to the last bit."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.learning import learner as learner_module
from adapter.learning.adam import same_bits
from adapter.learning.checkpoint import save_checkpoint
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import Mode
from sim.scenarios import build
from tests.helpers.arm_data import Motion, arm, learner_for, record, rubbing, states_of

HIDDEN = {
    "ideal": (arm, ()),
    "friction": (lambda: rubbing(0.4, 0.3), REAL_ARM_EFFECTS),
    "load": (lambda: build("payload_at_20s", mass=1.0, t_s=6.0).truth, ()),
    "links": (arm, ("viscous_friction",)),
}


@cache
def states(hidden: str) -> np.ndarray:
    """Filtered states with holes in time, and with some that are no numbers."""
    data = record(HIDDEN[hidden][0](), Motion(9.0, 5), links=hidden == "links")
    found = states_of(data)
    found = np.delete(found, np.r_[3000:3100, 4321], axis=0)
    found[[1700, 2500], 5] = np.nan
    return found


def everything(learner: OnlineLearner, folder: Path) -> dict[str, np.ndarray]:
    """All that a learner is, as a checkpoint has it."""
    path = folder / "state.npz"
    save_checkpoint(learner, path, sync=False)
    with np.load(path) as arrays:
        return dict(arrays)


@pytest.mark.parametrize("hidden", HIDDEN)
def test_the_same_bits(hidden: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    together, called = 0, learner_module.steps

    def steps(table: np.ndarray, parts: tuple, done: tuple) -> int:
        nonlocal together
        count = called(table, parts, done)
        together += count
        return count

    monkeypatch.setattr(learner_module, "steps", steps)
    one, many = (learner_for(effects=HIDDEN[hidden][1]) for _ in range(2))
    for state in states(hidden):
        one.step(state)
    sizes = np.random.default_rng(0).integers(1, 120, 400)
    for part in np.split(states(hidden), np.cumsum(sizes)):
        many.step_each(part)
    ours, theirs = everything(many, tmp_path), everything(one, tmp_path)
    assert ours.keys() == theirs.keys()
    assert [key for key, x in ours.items() if not same(x, theirs[key])] == []
    assert many.refused == one.refused == 2 and many.learned == len(states(hidden)) - 2
    assert len(many.changes) == (hidden == "load")
    if same_bits():  # else every state is a step of its own
        assert together > 0.2 * many.learned  # λ of noisy links takes most of the time


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


@pytest.mark.parametrize(
    "settings", [{"mode": Mode.SAMPLE}, {"update_every": 4}, {"wait_for_schema": False}], ids=str
)
def test_other_ways_to_learn(settings: dict, tmp_path: Path) -> None:
    """Those that a call does not serve go one by one."""
    one, many = (learner_for(**settings) for _ in range(2))
    table = states("ideal")[:1200]
    for state in table:
        one.step(state)
    many.step_each(table)
    ours, theirs = everything(many, tmp_path), everything(one, tmp_path)
    assert [key for key, x in ours.items() if not same(x, theirs[key])] == []


def test_a_watch_sees_every_state_once() -> None:
    class Watch:
        def __init__(self) -> None:
            self.reports: list[dict] = []
            self.seen = 0

        def __call__(self, learner: OnlineLearner, table: np.ndarray) -> None:
            self.seen += len(table)

    learner = learner_for()
    learner.watch = watch = Watch()
    learner.step_each(states("ideal"))
    assert watch.seen == learner.learned
