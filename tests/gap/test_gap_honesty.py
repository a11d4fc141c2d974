"""What keeps the gap's search honest: held-out data, doubt, budgets, limits. Each from both sides.

Small recordings of the nominal Panda with known friction and white noise; the expected numbers
come from plain least squares or from the way the recording was made.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.effects import CATALOGUE
from adapter.effects.active import WHOLE
from adapter.effects.catalogue import HELD
from adapter.gap import GapSettings, RecordingFault, RecordingRefused
from adapter.gap.candidates import Candidate, log_odds, signatures, stages_of
from adapter.gap.evidence import Carried, Noise
from adapter.gap.findings import doubted, findings_of, parameter_std, told_of
from adapter.gap.fit import Fit, Model, Named, refitted, worth
from adapter.gap.folds import (
    FOLD_S,
    FOLDS,
    LARGEST_SHARE,
    block_s,
    fold_of,
    fold_rows,
    pays_held_out,
    without_each,
)
from adapter.gap.held_out import (
    GapTask,
    _curves,
    lasting,
    rollout_errors,
    torque_errors,
    uncorrected,
)
from adapter.gap.real_arm import real_arm
from adapter.gap.result import Leftover
from adapter.gap.rivals import DATES, Standing, price
from adapter.gap.scan import BELIEF
from adapter.gap.search import Found, search, weak, worst
from adapter.gap.signals import Recorded, prepare
from adapter.gap.words import as_json, console_summary, headline
from adapter.judgement.priors import theta_prior
from adapter.model.inertia import theta_from_body
from adapter.model.robots import documented
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import refuse
from drivers.files.mcap import Log
from tests.helpers import gap_results
from tests.helpers.gap_tools import sines

Array = np.ndarray
PANDA = documented("panda")
ARM = RigidArm.of(PANDA)
N = ARM.n
SECONDS, NOISE_NM, PRIOR = 8.0, 0.05, 0.02
JOINT, FC = 3, 0.4  # joint (from 0), N m
LOAD_KG = 1.0
BASE_JOINT, B = 0, 0.03  # whose motor inertia links 1 and 2 can stand for, kg m2
MOTION = sines(3)
T = np.arange(0.0, SECONDS, 1e-3)
MOVED = MOTION.at(T)


def recording(seed: int, more: Array | float = 0.0, arm: RigidArm = ARM) -> Recorded:
    """An arm's torque on a known motion, with white noise and whatever else acts."""
    tau = arm.torque(*MOVED) + more
    noise = NOISE_NM * np.random.default_rng(seed).standard_normal(tau.shape)
    return Recorded("a", T, MOVED[0], MOVED[1], tau + noise)


def on_joint(joint: int, torque: Array) -> Array:
    out = np.zeros((len(T), N))
    out[:, joint] = torque
    return out


def nominal_fit(own: Recorded) -> Fit:
    """The nominal model under the white noise that was added: nothing is estimated of it."""
    signals = (prepare(own, ARM),)
    white = np.random.default_rng(0).standard_normal((len(signals[0].motion.t), N))
    noise = Noise(np.full(N, NOISE_NM * np.std(signals[0].low(white))), np.ones(N))
    model = Model(signals, np.zeros_like(ARM.theta))
    return Fit(model, theta_prior(ARM.theta, PRIOR)).with_noise([noise])


def candidate(fit: Fit, effect: str, joint: int) -> Candidate:
    _, found = signatures(stages_of(fit.recordings[0], ()), range(N))
    return next(c for c in found if c.key == (effect, joint))


def with_effect(fit: Fit, effect: str, joint: int, size: float) -> Fit:
    return fit.with_named([Named(candidate(fit, effect, joint), np.array([size]))])


# ---------------------------------------------------------------- held-out data


def test_each_block_is_scored_by_the_model_of_its_own_fold() -> None:
    """Model f reads 1 + f N m too much on joint 1: that is what its rows must be off by."""
    entries = [
        {"effect": "torque_offset", "joints": [1], "parameters": {"o": 1.0 + f}}
        for f in range(FOLDS)
    ]
    models = [replace(PANDA, effects=(entry,)) for entry in entries]
    errors = torque_errors(recording(1), PANDA, models, FOLD_S)
    extra = errors.before[:, 0] - errors.after[:, 0]
    assert np.allclose(extra, 1.0 + fold_of(errors.t, FOLD_S), atol=1e-9)
    assert np.allclose(errors.before[:, 1:], errors.after[:, 1:])


def test_each_segment_is_simulated_by_the_model_of_its_own_fold() -> None:
    def simulate(model, motion, segments, drive):
        out = np.full_like(motion.q, np.nan)
        for begin, end in segments:
            out[begin:end] = model.theta[0, 0]
        return out, out

    models = []
    for f in range(FOLDS):
        theta = PANDA.theta.copy()
        theta[0, 0] = 10.0 + f
        models.append(replace(PANDA, theta=theta))
    curves = rollout_errors(recording(1), PANDA, models, simulate, FOLD_S).curves
    told = np.isfinite(curves.after[:, 0])
    starts = 0.3 + 0.5 * np.floor((curves.t[told] - 0.3 + 1e-9) / 0.5)  # of each segment
    assert told.sum() > 0.8 * len(told)
    assert np.array_equal(curves.after[told, 0], 10.0 + fold_of(starts + 1e-9, FOLD_S))


def test_curves_show_what_a_fit_without_their_own_block_predicts() -> None:
    friction = on_joint(JOINT, FC * np.tanh(MOVED[1][:, JOINT] / 0.01))
    friction[(T > 2.0) & (T < 4.0)] *= 3.0  # one block differs, and must not know of it
    fit = with_effect(nominal_fit(recording(2, friction)), "coulomb_friction", JOINT, FC)
    fit, carried = refitted(fit)
    shown = _curves("a", Found(fit, carried, ()), 0)
    t, fold = fit.recordings[0].t, fold_rows(fit)
    for f in range(FOLDS):
        seen = fold != f  # least squares by stacked rows, the prior's among them
        rows = np.vstack([carried.N[:, seen].T, np.diag(1.0 / carried.prior_std)])
        data = np.append(carried.data[seen], np.zeros(len(carried.prior_std)))
        scale = carried.prior_std
        x = scale * np.linalg.lstsq(rows * scale, data, rcond=None)[0]
        own = fold_of(t, block_s(fit)) == f
        expected = fit.at(x).model.residual(0)[own]
        assert np.allclose(shown.after[own], expected, atol=1e-5)
        assert not np.allclose(shown.after[~own], fit.at(x).model.residual(0)[~own], atol=1e-5)


@pytest.mark.parametrize("throughout", [True, False])
def test_what_one_block_alone_shows_is_not_named(throughout: bool) -> None:
    """Evidence is ample both times; blocks that the fit has not seen pay for the one alone."""
    block = LARGEST_SHARE * SECONDS
    on = np.ones_like(T) if throughout else ((2 * block < T) & (3 * block > T)).astype(float)
    fit = with_effect(nominal_fit(recording(3, on_joint(6, 0.5 * on))), "torque_offset", 6, 0.5)
    fit, carried = refitted(fit)
    assert worth(fit, carried, 0).log_evidence > BELIEF + 20.0
    assert pays_held_out(fit, carried, without_each(fit, carried), 0) is throughout
    assert worst(fit, weak(fit, carried)) == (None if throughout else 0)


def test_what_any_arm_has_of_a_kind_takes_nothing_from_a_larger_one() -> None:
    """Springs of cables are small; where one is not, its blocks confirm that, and no prior."""
    bare = nominal_fit(recording(4, on_joint(0, -0.8 * MOVED[0][:, 0])))
    fit = real_arm(bare, range(N), ()).fit.with_noise(bare.noise)
    spring = Named(candidate(fit, "joint_spring", 0), np.zeros(2))
    assert any(e.assumed and e.candidate.key == spring.candidate.key for e in fit.named)
    fit, carried = refitted(fit.with_named([*fit.named, spring]))
    assert pays_held_out(fit, carried, without_each(fit, carried), len(fit.named) - 1)


def test_what_the_other_folds_leave_open_takes_nothing_from_an_effect() -> None:
    """A joint moves in two folds, in one of them beside what the others hardly show."""
    fit = with_effect(nominal_fit(recording(0)), "coulomb_friction", JOINT, FC)
    fold = np.repeat(np.arange(FOLDS), 200)
    without = [fold >= 0, *(fold != f for f in range(FOLDS))]
    rows = np.zeros((len(fit.coefficients), len(fold)))
    rows[0], rows[-1] = np.choose(fold, [1.0, 0.0, 1e-3, 1e-3]), fold < 2
    for seed in range(10):
        data = rows[-1] + np.random.default_rng(seed).standard_normal(len(fold))
        known = [Carried(rows[:, on], np.full(len(rows), 100.0), data[on]) for on in without]
        assert pays_held_out(fit, known[0], known[1:], 0)


# ---------------------------------------------------------------- doubt


def estimates(fit: Fit, seed: int) -> tuple[float, float]:
    """(estimate, std) of a motor inertia, which wrong links' inertias could stand for."""
    rng = np.random.default_rng([seed, 11])
    theta = ARM.theta + fit.prior * rng.standard_normal(ARM.theta.shape)
    own = fit.recordings[0]
    m, level = own.motion, fit.noise[0].level
    tau = ARM.changed(theta).torque(m.q, m.dq, m.ddq)
    tau[:, BASE_JOINT] += B * m.ddq[:, BASE_JOINT]
    read = own.low(tau) + level * rng.standard_normal(own.tau.shape)
    fit = replace(fit, model=replace(fit.model, recordings=(replace(own, tau=read),)))
    fit, carried = refitted(fit)
    (found,) = findings_of(settled_as(fit, carried), {"log": SECONDS})
    return found.parameters["B"], found.std["B"]


def settled_as(fit: Fit, carried) -> Found:
    """A search's outcome with nothing to choose from."""
    own = tuple(Standing(e.candidate, 50.0, 100.0, ()) for e in fit.named)
    return Found(fit, carried, own)


def test_standard_deviations_are_those_of_the_scatter() -> None:
    """Over arms whose inertias are off by their prior; neither too small nor too large."""
    fit = with_effect(nominal_fit(recording(4)), "motor_inertia", BASE_JOINT, 0.0)
    told = np.array([estimates(fit, seed) for seed in range(40)])
    pulls = (told[:, 0] - B) / told[:, 1]
    assert 0.7 < np.sqrt(np.mean(pulls**2)) < 1.35
    assert np.ptp(told[:, 1]) < 0.1 * told[0, 1]


def test_inertias_left_alone_are_no_surer_for_that() -> None:
    own = recording(5, on_joint(BASE_JOINT, B * MOVED[2][:, BASE_JOINT]))
    fit, carried = refitted(with_effect(nominal_fit(own), "motor_inertia", BASE_JOINT, B))
    free = settled_as(fit, carried)
    kept = uncorrected(free)
    assert not kept.fit.dtheta.any() and np.array_equal(kept.fit.prior, fit.prior)
    (before,), (after,) = (findings_of(x, {"log": SECONDS}) for x in (free, kept))
    assert after.std["B"] == pytest.approx(before.std["B"], rel=0.05)
    fast = kept.carried.std()[-1]  # with the inertias held fast
    assert after.std["B"] > 2.0 * fast


def test_a_joint_with_something_unexplained_is_believed_the_less() -> None:
    sure = gap_results.finding("coulomb_friction", (4,), {"Fc": 2.0}, evidence=0.9)  # 1.5 N m rms
    left = Leftover(4, 2.5, 2.0, ("q4",), (0.0, 20.0))  # 1.5 N m over its noise as well
    (found,) = doubted((sure,), (left,))
    assert found.evidence == pytest.approx(0.45)
    (elsewhere,) = doubted((sure,), (replace(left, joint=3),))
    (quiet,) = doubted((sure,), (replace(left, rmse_nm=2.0),))
    assert [elsewhere.evidence, quiet.evidence] == pytest.approx([0.9, 0.9])


@pytest.mark.parametrize("shaken", [True, False])
def test_what_is_told_of_a_shaken_joint_is_less_sure(shaken: bool) -> None:
    more = on_joint(JOINT, FC * np.tanh(MOVED[1][:, JOINT] / 0.01))
    if shaken:  # in no catalogue, and nothing like noise
        more += on_joint(JOINT, np.sin(2.0 * np.pi * 1.3 * T))
    fit = with_effect(nominal_fit(recording(6, more)), "coulomb_friction", JOINT, FC).with_noise()
    found = settled_as(fit, fit.carried())
    (own,), left = told_of(found, {"log": SECONDS}, fit.prior)
    assert {x.joint for x in left} == ({JOINT + 1} if shaken else set())
    assert own.evidence == pytest.approx(1.0) if not shaken else own.evidence < 0.5


# ---------------------------------------------------------------- budget


def two_frictions() -> Fit:
    speed = MOVED[1]
    more = on_joint(JOINT, FC * np.tanh(speed[:, JOINT] / 0.01)) + on_joint(5, 0.5 * speed[:, 5])
    return nominal_fit(recording(7, more))


def test_a_search_that_runs_out_of_rounds_says_so() -> None:
    fit = two_frictions()
    short, whole = (search(fit, (JOINT, 5), rounds) for rounds in (1, 24))
    assert short.ran_out and short.rounds == 1
    assert not whole.ran_out and 3 <= whole.rounds < 24
    named = {(e.candidate.effect.name, e.candidate.joint) for e in whole.fit.named}
    assert {("coulomb_friction", JOINT), ("viscous_friction", 5)} <= named
    with pytest.raises(ValueError, match="round"):
        GapSettings(rounds=0)


@pytest.mark.parametrize("kind", ["nothing", "one_finding"])
def test_running_out_is_in_the_sentence_and_in_the_file(kind: str) -> None:
    whole = getattr(gap_results, kind)()
    short = replace(whole, stopped_after_rounds=24)
    assert "stopped after 24 rounds" in headline(short)
    assert "stopped" not in headline(whole)
    assert as_json(short)["stopped_after_rounds"] == 24
    assert as_json(whole)["stopped_after_rounds"] is None
    assert "stopped after 24 rounds" in console_summary(short)[0]


# ---------------------------------------------------------------- limits of the screen


def log_of(q: Array, dq: Array, tau: Array | None = None, names=PANDA.tree.joint_names) -> Log:
    stamps = 1_000_000 * np.arange(len(q), dtype=np.int64)
    return Log(Path("a.mcap"), names, stamps, q, dq, ARM.torque(*MOVED) if tau is None else tau)


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_positions_beyond_either_limit_are_noted(side: str) -> None:
    """The model's limits are moved, not the arm: only the note may change."""
    noisy = recording(8)
    log = log_of(noisy.q, noisy.dq, noisy.tau)
    inside = refuse(log, PANDA)
    assert not [note for note in inside.notes if "may go from" in note]
    q = noisy.q[:, 2]
    bound = getattr(PANDA.limits, side).copy()
    bound[2] = np.median(q) + (0.3 if side == "lower" else -0.3)
    tight = replace(PANDA, limits=replace(PANDA.limits, **{side: bound}))
    (note,) = [note for note in refuse(log, tight).notes if "may go from" in note]
    assert note.startswith("panda_joint3 goes from")
    numbered = replace(log, joint_names=tuple(f"other{k}" for k in range(1, 8)))
    with pytest.raises(RecordingRefused) as refused:
        refuse(numbered, tight)
    assert refused.value.kind is RecordingFault.ROBOT


def test_degrees_of_an_arm_whose_joints_only_turn_backwards() -> None:
    low = np.full(N, -3.0)
    model = replace(PANDA, limits=replace(PANDA.limits, lower=low, upper=np.zeros(N)))
    degrees = 180.0 / np.pi
    q = -np.abs(MOVED[0]) - 0.5
    with pytest.raises(RecordingRefused) as refused:
        refuse(log_of(degrees * q, degrees * -np.sign(MOVED[0]) * MOVED[1]), model)
    assert refused.value.kind is RecordingFault.DEGREES


def test_a_task_whose_own_recordings_are_scored_is_by_folds() -> None:
    own = recording(1)
    task = GapTask(PANDA, (own,), (own,), ((0,),), 1e-3, True, ())
    assert task.folds and not replace(task, scored=(recording(2),)).folds


# ---------------------------------------------------------------- dates


def test_what_began_in_one_recording_acts_throughout_the_next_and_what_ended_is_gone() -> None:
    entry = {"effect": "torque_offset", "joints": [1], "parameters": {"o": 1.0}}
    spans = (None, [None, None], [2.0, None], [None, 3.0], [2.0, 3.0])
    model = replace(PANDA, effects=tuple({**entry, "interval_s": span} for span in spans))
    kept = lasting(model).effects
    assert len(kept) == 3  # the last two ended
    assert all((x["interval_s"] or [None, None]) == [None, None] for x in kept)


def test_each_date_of_an_effect_has_its_price() -> None:
    """Starts and ends that were looked for could have been found in noise."""
    fit = nominal_fit(recording(9))
    own = Named(candidate(fit, "torque_offset", 2), np.array([0.5]))

    def dates(begin: float, end: float) -> float:
        timed, passing = begin > -np.inf or end < np.inf, end < np.inf
        odds = log_odds(own.candidate, timed=timed, passing=passing)
        return (odds - price(replace(own, interval_s=(begin, end)))) / np.log(DATES)

    assert dates(-np.inf, np.inf) == 0.0
    assert dates(2.0, np.inf) == pytest.approx(1.0)
    assert dates(2.0, 4.0) == pytest.approx(2.0)


def test_what_a_hand_puts_down_it_held() -> None:
    """A load less from some time on is no lighter link, and needs a load before."""
    body, put_down_s = theta_from_body(LOAD_KG, (0.0, 0.01, 0.19), 2e-3 * np.eye(3)), 4.53
    held = ARM.theta.copy()
    held[-1] += body
    load = (ARM.changed(held).torque(*MOVED) - ARM.torque(*MOVED)) * (put_down_s > T)[:, None]
    own = recording(11, load + on_joint(JOINT, FC * np.sign(MOVED[1][:, JOINT])))
    found = search(nominal_fit(own), range(N), 1)
    before, change = sorted(
        (e for e in found.fit.named if e.candidate.effect is HELD), key=lambda e: e.interval_s[0]
    )
    assert before.interval_s == WHOLE and before.x[0] == pytest.approx(LOAD_KG, abs=0.05)
    assert change.x[0] == pytest.approx(-LOAD_KG, abs=0.02)
    assert change.interval_s[0] == pytest.approx(put_down_s, abs=0.02)
    assert all(e.candidate.effect.name != "link_inertia" for e in found.fit.named)


@pytest.mark.parametrize("vs", [0.03, 0.25])
def test_what_was_looked_for_on_a_grid_is_no_surer_than_the_grid(vs: float) -> None:
    effect = CATALOGUE["stribeck_friction"]
    template = next(x for x in effect.templates() if x.decode(np.ones(2))["vs"] == vs)
    fit = nominal_fit(recording(10))
    whole = Candidate(effect, template, JOINT, (0, 1))
    fit = fit.with_named([Named(whole, np.array([0.3, 0.5]))])
    std = parameter_std(fit, np.eye(len(fit.coefficients)) * 1e-4, 0)
    assert std["Fc"] == pytest.approx(0.01) and std["Fs"] == pytest.approx(0.01)
    share = next(x.grid_share for x in effect.parameters if x.key == "vs")
    assert std["vs"] == pytest.approx(share * vs)
