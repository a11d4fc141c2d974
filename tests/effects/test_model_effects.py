"""Effects that a model brings along: taken off what is not learned, refined where it is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.effects.active import active_effects, lasting_effects, with_bodies
from adapter.effects.torque import ModelTorque
from adapter.errors import SettingsError
from adapter.learning.checkpoint import load_checkpoint, save_checkpoint
from adapter.learning.known_effects import KnownEffects, believed, learnable, not_learned
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.learning.theta import STEP_SMOOTHING, KnownArm
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, matrix_from_zxz
from adapter.physics.rigid_arm import RigidArm
from adapter.runs.batch import learn_batch
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import collect, learned_model
from adapter.runs.pipeline import make_front_end, make_learner
from adapter.signals.records import StateLayout, stamps_of
from sim.effects import Effect
from tests.helpers.arm_data import (
    ArmData,
    Motion,
    arm,
    model_torque,
    panda_model,
    record,
    rms,
    rubbing,
    states_of,
    teach,
)
from tests.helpers.gap_effects import sense
from tests.helpers.robot_models import entry

N = 7
AT = StateLayout(N)
MOTION = Motion(10.0, seed=4)
LOAD = {"m": 1.0, "cx": 0.0, "cy": 0.01, "cz": 0.08, "inertia": [2e-3, 0, 0, 2e-3, 0, 2e-3]}
FRICTION = ("viscous_friction", "coulomb_friction")


def with_effects(*entries: dict[str, object], model: SelfModel | None = None) -> SelfModel:
    return replace(model or panda_model(), effects=entries)


TAKEN_OFF = {
    "encoder_offset": entry("encoder_offset", [4], o=0.02),
    "encoder_ripple": entry("encoder_ripple", [4], a=0.01, phase=0.4),
    "joint_elasticity": entry("joint_elasticity", [2], k=4000.0),
    "backlash": entry("backlash", [4], b=0.01),
    "torque_gain": entry("torque_gain", [2], g=0.08),
    "signal_delay": entry("signal_delay", d=0.004),
    "joint_spring": entry("joint_spring", [4], k=1.5, q0=-1.0),
    "torque_ripple": entry("torque_ripple", [2], a=0.4, n=3, phase=0.2),
    "load_dependent_friction": entry("load_dependent_friction", [2], Fl=0.06),
    "stribeck_friction": entry("stribeck_friction", [4], Fc=0.3, Fs=0.7, vs=0.1),
}
# what the low-pass makes of what jumps, or of the twist's rates, is not undone to the last bit
SHARE_LEFT = {"joint_elasticity": 0.2, "backlash": 0.1, "stribeck_friction": 0.15}  # else 0.05


def changed(data: ArmData, *names: str) -> ArmData:
    """The recording as an arm with effects of `TAKEN_OFF` gives it, by the tests' own equations.

    The speed at which a motor crosses the play is left out: it is far beyond the filter's band.
    """
    told = [TAKEN_OFF[name] for name in names]
    effects = [Effect(x["effect"], tuple(x["joints"]), x["parameters"]) for x in told]  # type: ignore[arg-type]
    read = sense(arm(), effects, 1e-9 * data.stamp_ns, *data.true[:3])
    q, dq, _, tau = data.true
    more = (x - true for x, true in zip(read, (q, dq, tau), strict=True))
    q, dq, tau = (x + y for x, y in zip((data.q, data.dq, data.tau), more, strict=True))
    return replace(data, q=q, dq=data.dq if "backlash" in names else dq, tau=tau)


def known_effects(*entries: dict[str, object]) -> KnownEffects:
    model = with_effects(*entries)
    smoothing_s = STEP_SMOOTHING * make_front_end(model, PipelineSettings()).delay_s
    return KnownEffects(lasting_effects(model.effects, N), RigidArm.of(model), smoothing_s)


def torque_left(states: np.ndarray) -> np.ndarray:
    """(m, n) torque that the documented arm does not explain."""
    model = panda_model()
    signals = (np.ascontiguousarray(states[:, k]) for k in (AT.q, AT.dq, AT.ddq))
    return states[:, AT.tau] - model_torque(model, model.lam, model.theta, *signals)


@pytest.mark.parametrize("name", TAKEN_OFF)
def test_what_is_known_is_taken_off(name: str) -> None:
    """In torque that the arm does not explain: with the effect, without, with it taken off."""
    clean = record(arm(), MOTION, noisy=False).part(8.0)
    without, seen = states_of(clean), states_of(changed(clean, name))
    without = without[np.isin(stamps_of(without), stamps_of(seen))]  # a jump is not learned from
    freed = known_effects(TAKEN_OFF[name]).take_off(seen)
    size = rms(torque_left(seen) - torque_left(without)).max()
    left = rms(torque_left(freed) - torque_left(without)).max()
    assert size > 0.02
    assert left < SHARE_LEFT.get(name, 0.05) * size


def test_tables_and_single_states_are_the_same() -> None:
    entries = tuple(TAKEN_OFF.values())
    states = states_of(record(arm(), MOTION).part(3.0))
    whole = known_effects(*entries).take_off(states)
    one = known_effects(*entries)
    np.testing.assert_array_equal(
        whole, np.concatenate([one.take_off(row[None]) for row in states])
    )


def test_a_hole_in_the_states_starts_the_rates_anew() -> None:
    states = states_of(record(arm(), MOTION).part(3.0))
    freed = known_effects(TAKEN_OFF["signal_delay"]).take_off(np.delete(states, slice(500, 900), 0))
    np.testing.assert_array_equal(freed[500, AT.tau], states[900, AT.tau])
    assert np.abs(freed[:, AT.tau] - np.delete(states, slice(500, 900), 0)[:, AT.tau]).max() < 1.0


def test_measured_link_motion_goes_with_the_links_angles() -> None:
    """λ of an arm whose encoder is off comes back as documented, its links being heard of."""
    data = changed(record(arm(), Motion(4.0, seed=2), links=True), "encoder_offset")
    model = with_effects(TAKEN_OFF["encoder_offset"])
    states = states_of(data, model)
    freed = known_effects(TAKEN_OFF["encoder_offset"]).take_off(states)
    np.testing.assert_allclose(freed[:, AT.motion_q][:, 3], states[:, AT.motion_q][:, 3] - 0.02)
    synthesized = states_of(changed(record(arm(), Motion(1.0, seed=2)), "encoder_offset"), model)
    freed = known_effects(TAKEN_OFF["encoder_offset"]).take_off(synthesized)
    np.testing.assert_array_equal(freed[:, AT.motion_q], synthesized[:, AT.motion_q])


def learn(data: ArmData, model: SelfModel, *effects: str) -> OnlineLearner:
    settings = PipelineSettings(learner=LearnerSettings(effects=effects, seed=3))
    return teach(make_learner(model, settings), states_of(data, model))


@cache
def plain() -> OnlineLearner:
    """Of the documented arm, from what it really gives."""
    return learn(record(arm(), MOTION), panda_model())


def held_out(learner: OnlineLearner, *effects: dict[str, object]) -> np.ndarray:
    """(n,) torque error of θ alone on another motion of an arm with effects, N m rms."""
    data = record(arm(), Motion(6.0, seed=104), noisy=False)
    q, dq, ddq = data.true[:3]
    tau = ModelTorque(with_effects(*effects))(q, dq, ddq, 1e-9 * data.stamp_ns)
    theta = learner.theta.theta
    base = with_bodies(with_effects(*effects))  # gravity alone is taken of it
    return rms(tau - model_torque(base, learner.schema.lam, theta, q, dq, ddq))


def test_theta_is_the_arms_where_the_model_knows_of_sensors_and_gears() -> None:
    names = ("encoder_offset", "torque_gain", "joint_elasticity", "joint_spring")
    data = changed(record(arm(), MOTION), *names)
    told = held_out(learn(data, with_effects(*(TAKEN_OFF[name] for name in names))))
    untold = held_out(learn(data, panda_model()))
    best = held_out(plain())
    assert (told < 1.5 * best + 0.03).all()
    assert untold.max() > 5 * told.max()


def wrong_friction(fc: float, std: float | None) -> SelfModel:
    joints = range(1, N + 1)
    levels = {**entry("coulomb_friction", joints, Fc=[fc] * N), "std": {"Fc": [std] * N}}
    viscous = {**entry("viscous_friction", joints, Fv=[0.05] * N), "std": {"Fv": [0.02] * N}}
    return with_effects(levels, viscous)


@pytest.mark.parametrize("std", [0.1, None])
def test_wrong_friction_is_refined(std: float | None) -> None:
    truth = rubbing(0.3, 0.05)
    model = wrong_friction(0.6, std)
    settings = LearnerSettings(effects=learnable(model, ()))
    assert settings.effects == FRICTION
    start = make_learner(model, PipelineSettings(learner=settings))
    np.testing.assert_array_equal(start.theta.effect_values[1], np.full(N, 0.6))
    learner = learn(record(truth, MOTION), model, *FRICTION)
    assert learner.known is None
    np.testing.assert_allclose(learner.theta.effect_values[1], 0.3, atol=0.05)
    np.testing.assert_allclose(learner.theta.effect_values[0], 0.05, atol=0.05)
    entries = learned_model(collect(learner), model).effects
    assert len(entries) == 2 * N and all(e["std"] for e in entries)


def test_friction_that_is_not_learned_is_taken_off() -> None:
    truth = rubbing(0.3, 0.05)
    model = wrong_friction(0.3, 0.1)
    learner = learn(record(truth, MOTION), model)
    assert learner.theta.effect_values.size == 0
    assert (held_out(learner) < 1.5 * held_out(plain()) + 0.03).all()
    kept = learned_model(collect(learner), model).effects
    assert kept == model.effects


def test_a_surer_model_is_left_less_easily() -> None:
    """The prior is the model's: values that data do not show stay where it had them."""
    model = wrong_friction(0.6, 0.001)
    learner = make_learner(model, PipelineSettings(learner=LearnerSettings(effects=FRICTION)))
    n = 10 * (N + 1)
    std = np.sqrt(1.0 / learner.theta.prior.diagonal()[n:]).reshape(2, N)
    np.testing.assert_allclose(std, [[0.02] * N, [0.001] * N])
    mean = learner.theta.prior_rhs[n:].reshape(2, N) * std**2
    np.testing.assert_allclose(mean, [[0.05] * N, [0.6] * N])


def test_two_entries_of_one_effect_add_up_and_so_do_their_doubts() -> None:
    """As a search leaves them that found what an earlier one had left."""
    told = (0.3, 0.03), (0.2, 0.04)  # N m s/rad: value and standard deviation
    twice = [entry("viscous_friction", (3,), Fv=x) | {"std": {"Fv": s}} for x, s in told]
    model = with_effects(*twice)
    values, std = believed(lasting_effects(model.effects, N), FRICTION, N)
    assert values[0, 2] == pytest.approx(0.5) and std[0, 2] == pytest.approx(0.05)
    rest = np.delete(values.ravel(), 2), np.delete(std.ravel(), 2)
    assert np.isnan(rest).all()


def test_bodies_are_in_the_model_the_learner_compares_with() -> None:
    """The arm stands on a tilted base: torques know, and λ is there as soon as ever."""
    tilt = entry("base_tilt", rx=0.03, ry=-0.02)
    model = with_effects(tilt, entry("payload", **LOAD))
    data = record(arm(), MOTION, noisy=False).part(8.0)
    turned = exp_rotation([0.03, -0.02, 0.0]).T @ panda_model().gravity
    tau = data.tau + ModelTorque(replace(panda_model(), gravity=turned))(*data.true[:3])
    tau -= ModelTorque(panda_model())(*data.true[:3])
    learner, level = (make_learner(m, PipelineSettings()) for m in (model, panda_model()))
    assert learner.known is None
    teach(learner, states_of(replace(data, tau=tau), model))
    teach(level, states_of(data))
    assert learner.theta_started_ns == level.theta_started_ns
    # how joint 1 turns about the vertical, no level base shows; it stays where it began
    np.testing.assert_allclose(learner.schema.R0[0], model.joint_rotation()[0], atol=0.02)
    for ours, theirs in zip(held_out(learner, tilt), held_out(level), strict=True):
        assert ours < 1.5 * theirs + 0.01
    # the same θ on a level base, where a tilt that nobody told leaves 1 N m
    assert held_out(learner).max() < 1.5 * held_out(level).max() + 0.01
    outcome = learned_model(collect(learner), model)
    assert outcome.effects == ()
    np.testing.assert_allclose(outcome.gravity, turned)


def test_measured_link_motion_feels_the_tilt() -> None:
    """Accelerations of the links hold gravity as it is."""
    model = with_effects(entry("base_tilt", rx=0.3, ry=-0.2))
    turned = with_bodies(model).gravity
    tilted = arm().with_changes(gravity=turned)
    data = record(tilted, Motion(4.0, seed=2), links=True)
    learner = teach(make_learner(model, PipelineSettings()), states_of(data, model))
    turn = matrix_from_zxz(learner.schema.lam[:, :3])
    assert np.abs(turn - model.joint_rotation()).max() < 0.02


def test_what_ended_with_its_recording_is_not_looked_for() -> None:
    contact = {**entry("torque_offset", [2], o=3.0), "interval_s": [1.0, 2.5]}
    model = with_effects(contact)
    learner = make_learner(model, PipelineSettings())
    assert learner.known is None and learner.given == ()
    assert learnable(model, ()) == ()
    assert learned_model(collect(learner), model).effects == ()
    begun = with_effects({**contact, "interval_s": [1.0, None]})
    (kept,) = learned_model(collect(make_learner(begun, PipelineSettings())), begun).effects
    assert kept["interval_s"] is None and kept["parameters"] == {"o": 3.0}


def test_a_checkpoint_goes_on_where_it_was(tmp_path: Path) -> None:
    model = with_effects(
        *(TAKEN_OFF[name] for name in ("signal_delay", "backlash", "joint_elasticity")),
        *wrong_friction(0.4, 0.1).effects,
    )
    settings = PipelineSettings(learner=LearnerSettings(effects=FRICTION))
    whole, first, second = (make_learner(model, settings) for _ in range(3))
    states = states_of(record(arm(), MOTION).part(3.0), model)
    save_checkpoint(teach(first, states[:1500], rows=1), tmp_path / "half.npz")
    load_checkpoint(second, tmp_path / "half.npz")
    for learner, part in ((whole, states), (second, states[1500:])):
        teach(learner, part, rows=1)
    np.testing.assert_array_equal(whole.theta.th, second.theta.th)
    for other in (panda_model(), with_effects(*wrong_friction(0.5, 0.1).effects)):
        with pytest.raises(SettingsError, match="other learner settings"):
            load_checkpoint(make_learner(other, settings), tmp_path / "half.npz")


def test_what_cannot_be_taken_off_is_said() -> None:
    drift = entry("friction_drift", [2], dFc=0.01)
    model = with_effects(drift, entry("base_tilt", rx=0.01, ry=0.0))
    assert not_learned(model, ()) == ["the learner leaves out friction_drift"]
    assert not_learned(panda_model(), ()) == []


def test_batches_take_off_what_is_known() -> None:
    """The model is the arm's, spring and offset included: in batches as sample by sample."""
    model = with_effects(TAKEN_OFF["joint_spring"], TAKEN_OFF["encoder_offset"])
    data = changed(record(arm(), MOTION), "joint_spring", "encoder_offset")
    learner = make_learner(model, PipelineSettings())
    learn_batch(learner, [states_of(data, model)], 10, lambda done: None)
    assert held_out(learner).max() < 0.05


def test_effects_need_an_arm() -> None:
    model = with_effects(TAKEN_OFF["joint_spring"])
    known = lasting_effects(model.effects, N)
    with pytest.raises(SettingsError, match="model's arm"):
        OnlineLearner(model.tree, model.gravity, known=KnownArm(effects=known))


def test_a_wrong_link_read_from_a_file_is_more_than_noise() -> None:
    """Its ten numbers and their doubts are lists there."""
    for size, shown in ((0.1, True), (0.02, False)):
        own = {"parameters": {"dtheta": [size] * 10}, "std": {"dtheta": [0.01] * 10}}
        (active,) = active_effects([{"effect": "link_inertia", "joints": [2], **own}], 7)
        assert active.shown == shown
