"""The learner on trees: floating and fixed, with effects, loads, checkpoints; what it refuses."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.errors import ModelError, SettingsError
from adapter.learning.checkpoint import load_checkpoint, save_checkpoint
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import ChangeSettings, LearnerSettings, SchemaSettings
from adapter.learning.theta import KnownArm
from adapter.learning.tree_data import TreeData
from adapter.model.inertia import is_consistent
from adapter.model.self_model import SelfModel
from adapter.physics.identifiability import frame_observability
from adapter.runs.outcome import frame_errors
from tests.helpers.tree_motion import in_motion, random_tree_text, with_noise

PAUSE_NS = 10**10  # between two motions


@cache
def falling(seed: int) -> tuple[SelfModel, tuple[TreeData, ...], TreeData]:
    """A random floating tree of six joints: model, two motions to learn from, one to judge by."""
    text = random_tree_text(6, seed)
    model, first = in_motion(text, True, 3.0, 10 * seed)
    others = [in_motion(text, True, s, 10 * seed + k)[1] for k, s in ((1, 3.0), (2, 0.5))]
    return model, (first, others[0]), others[1]


def bare(data: TreeData) -> TreeData:
    """What gyroscopes and accelerometers leave: no velocities."""
    assert data.links is not None
    return replace(data, base=replace(data.base, v=None), links=replace(data.links, v=None))


def states_of(data: TreeData, number: int = 0) -> np.ndarray:
    return data.states(first_ns=number * PAUSE_NS)


SLOW = pytest.mark.slow
FALLEN = [(1, "all"), *(pytest.param(*x, marks=SLOW) for x in [(2, "bare"), (3, "carried")])]


@pytest.mark.parametrize("seed,kind", FALLEN)
def test_a_falling_tree_is_learned(seed: int, kind: str) -> None:
    model, parts, test = falling(seed)
    schema = SchemaSettings(judge_every=20, spin_measured=kind != "carried")
    settings = LearnerSettings(rebuild_rows=3, rebuild_stds=3.0, schema=schema)
    learner = OnlineLearner(model.tree, settings=settings)
    for k, part in enumerate(parts):
        data = with_noise(part if kind == "all" else bare(part), seed + k)
        if kind == "carried":
            assert data.links is not None
            data = replace(data, links=replace(data.links, dw=np.zeros_like(data.links.dw)))
        for state in states_of(data, k):
            assert learner.step(state)
    seen = frame_observability(model.tree, model.lam, model.gravity)
    turn, shift = frame_errors(learner.schema.lam[None], model.lam, seen.freedom)
    assert learner.theta_started_ns is not None and learner.theta_started_ns < 4e9
    assert turn.max() < 2e-3 and shift.max() < 3e-3
    error = (learner.predict(states_of(test)) - test.tau)[:, 6:]
    assert (error**2).mean() < 0.05**2 * (test.tau[:, 6:] ** 2).mean()
    in_use = learner.theta.th.copy()
    learner.theta.th[:] = learner.theta.least_squares()
    batch = (learner.predict(states_of(test)) - test.tau)[:, 6:]
    learner.theta.th[:] = in_use
    assert (error**2).mean() < 1.5**2 * (batch**2).mean()
    assert is_consistent(learner.theta.theta)
    assert not learner.changes


@cache
def on_a_table(seed: int) -> tuple[SelfModel, TreeData]:
    return in_motion(random_tree_text(3, seed), False, 4.0, seed)


def test_a_fixed_tree_with_friction_and_fewer_updates() -> None:
    model, data = on_a_table(4)
    friction = np.array([0.3, 0.2, 0.4])
    data = replace(data, tau=data.tau + friction * data.dq)
    with pytest.raises(SettingsError, match="gravity"):
        OnlineLearner(model.tree)
    settings = LearnerSettings(effects=("viscous_friction",), update_every=2)
    learner = OnlineLearner(model.tree, model.gravity, settings)
    for state in states_of(data)[:3500]:
        assert learner.step(state)
    assert learner.schema.updates == 1750 and learner.theta_started_ns is not None
    rest = data.take(slice(3500, None))
    error = learner.predict(states_of(rest)) - rest.tau
    assert np.sqrt((error**2).mean()) < 0.02 * np.sqrt((rest.tau**2).mean())
    assert np.allclose(learner.theta.effect_values[0], friction, atol=0.03)


def test_what_is_not_finite_is_refused_and_counted() -> None:
    model, parts, _ = falling(1)
    learner = OnlineLearner(model.tree, settings=LearnerSettings(wait_for_schema=False))
    states = states_of(parts[0])
    for state in states[:300]:
        learner.step(state)

    def knowledge() -> list[np.ndarray]:
        parts = learner.adam.parameters, learner.schema.lam
        return [x.copy() for x in (*parts, *learner.schema.moments, *learner.theta.moments)]

    before, at, bad = knowledge(), learner.layout, 0
    columns = (at.q, at.dq, at.ddq, at.tau, at.base, at.motion_q, at.motion_dq, at.motion)
    for part in columns:
        for value in (np.nan, np.inf, -np.inf, 1e300):
            state = states[300].copy()
            state[part.stop - 1] = value
            assert not learner.step(state)
            bad += 1
    assert learner.refused == bad and learner.learned == 300
    assert all(np.array_equal(x, y) for x, y in zip(before, knowledge(), strict=True))
    mixed = states[300:310].copy()
    mixed[3, at.dq] = np.nan
    assert learner.step_table(mixed) == 9 and learner.learned == 309
    assert np.isfinite(learner.adam.parameters).all() and np.isfinite(learner.theta.th).all()
    with pytest.raises(ModelError, match=f"{at.size} numbers"):
        learner.step(states[0][:-1])


@cache
def with_load(mass: float) -> tuple[SelfModel, np.ndarray]:
    """A floating tree, and its states in three motions, with a body on link l3 in the last."""
    text = random_tree_text(4, 6)
    model, first = in_motion(text, True, 4.0, 6)
    load = (
        f'<link name="load"><inertial><origin xyz="0.05 0 0.1"/><mass value="{mass}"/>'
        '<inertia ixx="0.002" ixy="0" ixz="0" iyy="0.002" iyz="0" izz="0.002"/></inertial></link>'
        '<joint name="grip" type="fixed"><parent link="l3"/><child link="load"/></joint></robot>'
    )
    second = in_motion(text, True, 3.0, 7)[1]
    third = in_motion(text.replace("</robot>", load), True, 3.0, 8)[1]
    parts = [with_noise(data, k, 0.2) for k, data in enumerate((first, second, third))]
    return model, np.concatenate([states_of(data, k) for k, data in enumerate(parts)])


def test_a_falling_tree_notices_a_load_and_goes_on_from_a_checkpoint(tmp_path: Path) -> None:
    """The load is weighed; a learner cut short, before or behind it, ends with the same bits."""
    mass = 6.0
    model, states = with_load(mass)
    change = ChangeSettings(slow=300, arm_after=4000, one_factor=2.5, wait=60)
    settings = LearnerSettings(effects=("viscous_friction",), change=change)
    known = KnownArm(hand=model.tree.link_names.index("l3"))
    whole, first, second = (
        OnlineLearner(model.tree, None, settings, known=known) for _ in range(3)
    )
    for state in states:
        whole.step(state)
    assert len(whole.changes) == 1
    assert 0 <= whole.changes[0] - 2 * PAUSE_NS < 3e8
    since = whole._held_to - whole._held_from  # samples with the bare hand are dropped
    assert whole.rebuilds > 1 and whole.theta.count == since <= 3000
    theta, best = whole.theta, whole.theta.least_squares()
    _, covariance = theta.payload
    std = float(np.sqrt(covariance[0, 0]))
    assert best[theta.spare][0] - best[theta.hand][0] == pytest.approx(mass, abs=4 * std)
    assert std < 0.02 * mass
    assert (theta.variance() < 4.0 * theta.variance(best)).all()  # ADAM is on its way
    for cut in (900, 6900, 7500):
        for state in states[first.learned : cut]:
            first.step(state)
        save_checkpoint(first, tmp_path / "c.npz")
        first = OnlineLearner(model.tree, None, settings, known=known)
        load_checkpoint(first, tmp_path / "c.npz")
    load_checkpoint(second, tmp_path / "c.npz")
    for state in states[7500:]:
        second.step(state)
    parts = [(whole, second)]
    parts += [(getattr(whole, x), getattr(second, x)) for x in ("schema", "theta", "change")]
    for a, b in parts:
        for name, value in vars(a).items():
            if isinstance(value, np.ndarray | int | float | bool) and name != "_held":
                np.testing.assert_array_equal(value, getattr(b, name), name)
    held = np.arange(whole._held_from, whole._held_to)
    assert np.array_equal(whole._held[held], second._held[held]) and len(held) > 2000
    for a, b in zip(whole.theta.moments, second.theta.moments, strict=True):
        assert np.array_equal(a, b)


def test_a_change_is_looked_for_in_the_joints_torques(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand that falls shows a load in its joints; the base's wrench has other units and noise."""
    model, parts, _ = falling(1)
    learner = OnlineLearner(model.tree, settings=LearnerSettings(wait_for_schema=False))
    seen: list[np.ndarray] = []

    def look(error: np.ndarray, *about: object) -> bool:
        return bool(seen.append(error.copy()))

    monkeypatch.setattr(learner.change, "look", look)
    state = states_of(parts[0])[0]
    expected = state[learner.layout.tau] - learner.predict(state[None])[0]
    learner.step(state)
    (found,) = seen
    assert np.allclose(found[0], expected[6:], rtol=1e-9)
    assert (np.abs(expected[:6] - expected[6:]) > 0.1).all()  # six joints, six parts of a wrench
