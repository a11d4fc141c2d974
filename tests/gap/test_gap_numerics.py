"""What the gap's search computes, against known motions, known noise and plain Gaussian algebra.

Products, Schur complements and running sums of the search are compared with full covariances
(scipy's multivariate normal), signatures with finite differences of the full predicted torque.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from adapter.effects import CATALOGUE
from adapter.effects.active import WHOLE, Active
from adapter.effects.base import LINK, Motion
from adapter.effects.bodies import theta_of
from adapter.effects.by_joint import AT_REST
from adapter.effects.torque import sensed_torque
from adapter.gap.candidates import Candidate, log_odds, patterns, signatures, stages_of
from adapter.gap.evidence import Carried, noise_of, score
from adapter.gap.findings import parameter_std
from adapter.gap.fit import (
    Fit,
    Model,
    Named,
    beside,
    place_of,
    refitted,
    under_own_noise,
    unsure,
    worth,
)
from adapter.gap.hand import MASSES_KG, Hand
from adapter.gap.held_out import possible
from adapter.gap.rivals import Rival, Standing, standings
from adapter.gap.scan import BELIEF, BLOCK_S, PATTERNS, SUDDEN_S, SignatureTable, honest_moves
from adapter.gap.signals import RATE_HZ, Recorded, Signals, low, prepare, smooth_motion
from adapter.judgement.noise import LEAST_NM
from adapter.judgement.priors import theta_prior
from adapter.model.inertia import is_consistent
from adapter.model.robots import documented
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.gap_tools import sines

Array = np.ndarray
ARM = RigidArm.of(documented("panda"))
N = ARM.n
DRAWN = sines(3)
SECONDS = 8.0
TAU_NOISE, RUBS, FC = 0.05, 3, 0.4  # N m; joint (from 0) with friction, N m
EVERYWHERE = tuple(range(N))


def noisy(x: Array, size: float, seed: int) -> Array:
    return x + size * np.random.default_rng(seed).standard_normal(x.shape)


# ---------------------------------------------------------------- smooth motion


def known(seconds: float = 12.0) -> tuple[Array, tuple[Array, Array, Array]]:
    t = np.arange(0.0, seconds, 1e-3)
    return t, DRAWN.at(t)


def errors(t: Array, q: Array, dq: Array, late_s: float = 0.0) -> list[float]:
    """rms errors of q, dq, ddq, of their own rms about the mean, away from the ends."""
    inside = (t > 0.2) & (t < t[-1] - 0.2)
    found = smooth_motion(t, q, dq, late_s).at(t[inside])
    truth = DRAWN.at(t[inside])
    return [float((a - b).std() / b.std()) for a, b in zip(found, truth, strict=True)]


def test_spline_through_a_motion_without_noise():
    t, (q, dq, _) = known()
    assert max(errors(t, q, dq)) < 1e-3


def test_spline_through_noise_of_a_real_arm_whose_levels_it_knows():
    t, (q, dq, _) = known()
    q, dq = noisy(q, 1e-4, 1), noisy(dq, 5e-3, 2)
    found = errors(t, q, dq)
    raw = np.gradient(dq, t, axis=0)
    assert found[0] < 2e-4 and found[1] < 5e-3 and found[2] < 0.03
    assert found[2] < 0.05 * (raw - known()[1][2]).std() / raw.std()
    spline = smooth_motion(t, q, dq)
    assert np.allclose(spline.q_noise, 1e-4, rtol=0.1)
    assert np.allclose(spline.dq_noise, 5e-3, rtol=0.1)


def test_rates_are_those_of_the_curve():
    t, (q, dq, _) = known()
    spline = smooth_motion(t, noisy(q, 1e-4, 5), noisy(dq, 5e-3, 6))
    at = np.arange(1.0, 10.0, 0.0137)
    h = 1e-5
    q, dq, ddq = spline.at(at)
    ahead, behind = spline.at(at + h), spline.at(at - h)
    assert np.allclose(dq, (ahead[0] - behind[0]) / (2 * h), atol=1e-6)
    assert np.allclose(ddq, (ahead[1] - behind[1]) / (2 * h), atol=1e-5)


def test_spline_through_jitter_and_a_hole():
    t, _ = known()
    rng = np.random.default_rng(7)
    kept = (rng.random(len(t)) > 0.1) & ~((t > 5.0) & (t < 5.02))
    t = t[kept] + rng.uniform(-3e-4, 3e-4, kept.sum())
    q, dq, _ = DRAWN.at(t)
    assert max(errors(t, q, dq)) < 2e-3


@pytest.mark.parametrize("late_s", [-1e-3, 5e-4, 3e-3])
def test_a_late_dq_is_put_right(late_s: float):
    t, (q, _, _) = known()
    dq = DRAWN.at(np.maximum(t - late_s, 0.0))[1]
    q, dq = noisy(q, 1e-4, 8), noisy(dq, 2e-3, 9)
    right, ignored = errors(t, q, dq, late_s), errors(t, q, dq)
    assert right[1] < 3e-3 and right[2] < 0.03
    assert right[1] < ignored[1]


# ---------------------------------------------------------------- low-pass


def recorded(tau: Array, t: Array, q: Array, dq: Array, name: str = "a") -> Recorded:
    return Recorded(name, t, q, dq, tau)


def test_low_pass_keeps_its_band_and_its_instants():
    t = np.arange(0.0, 20.0, 1.0 / RATE_HZ)
    at = low(t[:, None])[:, 0]  # a ramp goes through a symmetric filter as it is
    assert np.allclose(np.diff(at), 0.04)
    for hz, share in ((0.5, 1.0), (4.0, 1.0), (6.0, 1.0), (13.5, 0.0), (30.0, 0.0)):
        out = low(np.sin(2 * np.pi * hz * t)[:, None])[:, 0]
        assert np.allclose(out, share * np.sin(2 * np.pi * hz * at), atol=0.02), hz


@pytest.mark.parametrize(("sharp", "room"), [(False, 2e-3), (True, 2e-2)])
def test_one_filter_for_measured_and_modelled_torque(sharp: bool, room: float):
    """1 kHz through the measured torque's path, 250 Hz through the modelled one's."""
    t, (q, dq, ddq) = known()
    law = np.sign if sharp else lambda v: np.tanh(v / 0.3)

    def torque(*moved: Array) -> Array:
        return ARM.torque(*moved) + 0.5 * law(moved[1])

    signals = prepare(recorded(torque(q, dq, ddq), t, q, dq), ARM)
    assert np.allclose(signals.low(signals.motion.t[:, None])[:, 0], signals.t)
    modelled = signals.low(torque(*DRAWN.at(signals.motion.t)))
    off = modelled - signals.tau
    assert np.sqrt(np.mean(off**2, axis=0)).max() < room


def test_what_lies_above_the_band_does_not_fold_into_it():
    t, (q, dq, ddq) = known()
    tau = ARM.torque(q, dq, ddq)
    shaken = tau + np.sin(2 * np.pi * np.array([20.0, 33, 47, 120, 240, 251, 490]) * t[:, None])
    clean, other = (prepare(recorded(x, t, q, dq), ARM).tau for x in (tau, shaken))
    assert np.abs(other - clean).max() < 0.02


def test_too_short_a_recording_is_refused():
    t, (q, dq, _) = known(1.1)
    with pytest.raises(ValueError, match=r"1\.2 s"):
        prepare(recorded(q, t, q, dq), ARM)


def test_repeats_are_told_from_other_motions():
    t, (q, dq, _) = known(6.0)
    first, again = (
        recorded(q, t, noisy(q, 1e-4, k), noisy(dq, 5e-3, k + 9), str(k)) for k in (1, 2)
    )
    p, dp, _ = sines(4).at(t)
    other = recorded(p, t, p, dp, "other")
    assert first.repeated_in((first, other, again)) is again
    assert other.repeated_in((first, other, again)) is None
    moved = prepare(first, ARM, again).motion
    assert np.array_equal(moved.q, prepare(again, ARM).motion.q)


# ---------------------------------------------------------------- noise

ROWS = 480  # 19 s at 25 Hz
PROCESSES = {"white": [], "first order": [0.8], "resonant": [1.5, -0.9], "rough": [-0.5]}


def process(name: str, seed: int, columns: int = N, rows: int = ROWS) -> Array:
    """x_t = sum a_i x_(t-i) + e_t with unit e, in its steady state."""
    e = np.random.default_rng(seed).standard_normal((rows + 300, columns))
    return lfilter([1.0], [1.0, *(-a for a in np.array(PROCESSES[name], float))], e, axis=0)[300:]


def spread(name: str) -> float:
    """Standard deviation of a process, from its Lyapunov equation."""
    a = PROCESSES[name]
    if not a:
        return 1.0
    step = np.eye(len(a), k=-1)
    step[0] = a
    drive = np.zeros((len(a), len(a)))
    drive[0, 0] = 1.0
    return float(np.sqrt(solve_discrete_lyapunov(step, drive)[0, 0]))


@pytest.mark.parametrize("name", PROCESSES)
def test_noise_of_a_known_process(name: str):
    found = [noise_of(0.3 * process(name, seed)) for seed in range(30)]
    assert np.mean([x.level for x in found]) == pytest.approx(0.3 * spread(name), rel=0.15)


def test_as_many_rows_count_as_are_independent():
    """By how far means of a process that remembers scatter, against the noise's own memory."""
    means = [process("first order", seed).mean(axis=0) for seed in range(60)]
    memory = np.mean([noise_of(process("first order", seed)).memory for seed in range(60)])
    scatter = ROWS * np.var(means) / spread("first order") ** 2  # 1 without memory
    assert 0.6 * scatter < memory < 1.2 * scatter
    assert np.all(noise_of(process("rough", 1)).memory == 2.5)  # the band lets no more be told


def test_rows_that_do_not_count_are_no_noise():
    x = 0.1 * process("first order", 1)
    struck, weight = x.copy(), np.ones_like(x)
    struck[200:240] += 3.0  # a contact of 1.6 s
    weight[200:240] = 0.0
    np.testing.assert_allclose(noise_of(struck, weight).level, noise_of(x).level, rtol=0.1)


def test_no_sensor_is_quieter_than_the_floor():
    found = noise_of(np.zeros((ROWS, 2)))
    assert np.all(found.level >= LEAST_NM) and np.all(np.isfinite(found.memory))


# ---------------------------------------------------------------- evidence


def gaussians(seed: int) -> tuple[Array, Array, Array, Array, Array]:
    """Signatures X with priors, carried ones N that they overlap with, and data."""
    rng = np.random.default_rng(seed)
    N_, own = rng.standard_normal((4, 30)), rng.uniform(0.2, 2.0, 3)
    X = rng.standard_normal((3, 30)) + 2.0 * rng.standard_normal((3, 4)) @ N_
    carried = rng.uniform(0.1, 3.0, 4)
    data = rng.standard_normal(30) + (own * rng.standard_normal(3)) @ X
    return X, own, N_, carried, data + (carried * rng.standard_normal(4)) @ N_


def covariance(*parts: tuple[Array, Array]) -> Array:
    """Of the data when coefficients of signatures have these priors and noise is white."""
    size = parts[0][0].shape[1]
    return np.eye(size) + sum((x.T * std**2) @ x for x, std in parts)


def log_likelihood(data: Array, cov: Array) -> float:
    return float(multivariate_normal(np.zeros(len(data)), cov).logpdf(data))


@pytest.mark.parametrize("seed", range(5))
def test_score_is_a_ratio_of_marginal_likelihoods(seed: int):
    X, own, _, _, data = gaussians(seed)
    found = score(X @ X.T, X @ data, own)
    cov = covariance((X, own))
    expected = log_likelihood(data, cov) - log_likelihood(data, np.eye(len(data)))
    assert found.log_evidence == pytest.approx(expected, rel=1e-9)
    assert found.chi2 == pytest.approx(data @ data - data @ np.linalg.solve(cov, data), rel=1e-9)
    assert np.allclose(found.x, own**2 * (X @ np.linalg.solve(cov, data)))


@pytest.mark.parametrize("seed", range(5))
def test_what_is_carried_along_is_integrated_out(seed: int):
    X, own, N_, std, data = gaussians(seed)
    carried = Carried(N_, std, data)
    found = score(*carried.without(X), own)
    with_it, without = covariance((X, own), (N_, std)), covariance((N_, std))
    expected = log_likelihood(data, with_it) - log_likelihood(data, without)
    assert found.log_evidence == pytest.approx(expected, rel=1e-8)
    assert np.allclose(found.x, own**2 * (X @ np.linalg.solve(with_it, data)))
    fall = data @ np.linalg.solve(without, data) - data @ np.linalg.solve(with_it, data)
    assert found.chi2 == pytest.approx(fall, rel=1e-8)


def test_what_is_known_of_carried_coefficients():
    _, _, N_, std, data = gaussians(9)
    carried, cov = Carried(N_, std, data), covariance((gaussians(9)[2], std))
    gain = (std**2)[:, None] * N_ @ np.linalg.inv(cov)
    assert np.allclose(carried.x, gain @ data)
    assert np.allclose(carried.covariance(), np.diag(std**2) - gain @ (N_.T * std**2))
    assert np.allclose(carried.std() ** 2, np.diagonal(carried.covariance()))


# ---------------------------------------------------------------- signatures


def recording(seed: int = 1, friction: float = FC, noise: float = TAU_NOISE) -> Recorded:
    """Eight seconds of the nominal arm, friction on one joint, white noise."""
    t, (q, dq, ddq) = known(SECONDS)
    tau = ARM.torque(q, dq, ddq)
    tau[:, RUBS] += friction * np.tanh(dq[:, RUBS] / 0.01)
    return recorded(noisy(tau, noise, seed), t, q, dq)


def fit_of(*recordings: Recorded) -> Fit:
    """The nominal model on recordings."""
    signals = tuple(prepare(r, ARM) for r in recordings)
    zero = np.zeros_like(ARM.theta)
    return Fit(Model(signals, zero), theta_prior(ARM.theta, 0.02)).with_noise()


@pytest.fixture(scope="module")
def signals() -> Signals:
    return prepare(recording(), ARM)


@pytest.fixture(scope="module")
def table(signals: Signals) -> tuple[Array, list[Candidate]]:
    """Every signature of the recording, and what each belongs to."""
    return signatures(stages_of(signals, ()), EVERYWHERE)


@pytest.fixture(scope="module")
def field() -> SignatureTable:
    """Of a recording whose joint RUBS + 1 has friction that the model lacks."""
    return SignatureTable(fit_of(recording()), EVERYWHERE)


SMALL = 0.02  # of a coefficient's size, a difference


def full_torque(motion: Motion, *effects: Active) -> Array:
    return low(sensed_torque(motion, effects))


@pytest.mark.parametrize("name", [name for name in CATALOGUE if not CATALOGUE[name].is_theta])
def test_signatures_are_slopes_of_the_full_torque(
    name: str, signals: Signals, table: tuple[Array, list[Candidate]]
):
    """For every template of the effect: on the arm or all joints, and on three of them."""
    slopes, candidates = table
    assert len(slopes) == 1 + max(k for c in candidates for k in c.columns)
    nothing = full_torque(signals.motion)
    own = [c for c in candidates if c.effect.name == name and c.joint in (-1, 1, 3, 6)]
    assert own
    for c in own:
        for i, (column, std) in enumerate(zip(c.columns, c.prior_std, strict=True)):
            x = np.zeros(len(c.columns))
            x[i] = std if c.template.chord else SMALL * std
            active = Active(c.effect, c.joint, c.template.decode(x))
            slope = (full_torque(signals.motion, active) - nothing) / x[i]
            assert np.allclose(slopes[column], slope, atol=1e-6 * np.abs(slope).max() + 1e-9), c


def test_first_signatures_are_those_of_theta(
    signals: Signals, table: tuple[Array, list[Candidate]]
):
    slopes, candidates = table
    nothing = full_torque(signals.motion)
    for k in (0, 13, 27, 44, 69):
        theta = ARM.theta.copy()
        theta.ravel()[k] += 0.1
        moved = full_torque(replace(signals.motion, arm=ARM.changed(theta))) - nothing
        assert np.allclose(slopes[k], moved / 0.1, atol=1e-8 * (1.0 + np.abs(moved).max()))
    bodies = {c.key: c.columns for c in candidates if c.columns_are_theta}
    assert bodies["link_inertia", 2] == tuple(range(20, 30))


def test_signatures_of_a_load_are_those_of_its_body(signals: Signals):
    """One kilogram at the likely centre, and moments about it: the same torque as such a body's."""
    hand = Hand(np.array([0.02, 0.01, 0.19]), 0.08)
    table, candidates = signatures(stages_of(signals, ()), range(ARM.n), hand=hand)
    loads = [c for c in candidates if c.key == ("payload", -1)]
    assert [c.template.label for c in loads] == [f"about {m:g} kg" for m in MASSES_KG]
    x = np.array([1.5, 0.02, -0.01, 0.05, *[1e-3] * 6])
    theta = ARM.theta.copy()
    theta[-1] += theta_of(loads[1].template.decode(x))
    moved = full_torque(replace(signals.motion, arm=ARM.changed(theta))) - full_torque(
        signals.motion
    )
    torque = np.tensordot(x, table[list(loads[1].columns)], 1)
    assert np.allclose(torque, moved, atol=1e-8 * (1.0 + np.abs(moved).max()))
    alone = loads[1].template.decode(np.eye(10)[0])
    assert np.allclose([alone["cx"], alone["cy"], alone["cz"]], hand.centre)


def test_signatures_that_are_kept_are_those_of_any_model():
    """What hangs on the measured motion alone is computed once, whatever the inertias are."""
    other = ARM.changed(theta=1.2 * ARM.theta)
    ways = [(x, RUBS, x.templates()[0]) for x in patterns(RUBS)]
    used, fresh = prepare(SHORT, ARM), prepare(SHORT, ARM)
    signatures(stages_of(used, ()), EVERYWHERE, ways)
    kept, _ = signatures(stages_of(used, (), other), EVERYWHERE, ways)
    anew, _ = signatures(stages_of(fresh, (), other), EVERYWHERE, ways)
    assert np.array_equal(kept, anew)


def test_joints_that_stand_still_have_no_candidates(signals: Signals):
    _, candidates = signatures(stages_of(signals, ()), (0, 2))
    places = {c.joint for c in candidates if c.effect.scope != LINK}
    assert places == {-1, 0, 2}


NAMED = {  # effect -> joint (from 0) and coefficients about which it is differentiated
    "coulomb_friction": (1, [0.4]),
    "torque_ripple": (2, [0.2, -0.1]),
    "joint_elasticity": (3, [1.5e-4]),
    "torque_gain": (1, [0.05]),
    "encoder_offset": (3, [0.01]),
    "payload": (-1, [1.0, 0.02, -0.01, 0.15, 0.03, 0.0, 0.0, 0.03, 0.0, 0.01]),
    "base_tilt": (-1, [0.02, -0.03]),
    "torque_filter": (-1, [3e-3, 1e-5]),
    "external_wrench": (-1, [5.0, -3.0, 8.0, 0.1, 0.2, 0.0]),
}


def named(fit: Fit, name: str, interval_s: tuple[float, float] = WHOLE) -> Named:
    joint, x = NAMED[name]
    candidates = signatures(stages_of(fit.recordings[0], ()), EVERYWHERE)[1]
    first = next(c for c in candidates if c.key == (name, joint))
    return Named(first, np.array(x), interval_s)


SPANS = (WHOLE, (3.0, np.inf), (2.0, 4.5))
CARRIED = [(name, SPANS[k % 3]) for k, name in enumerate(NAMED)]
CARRIED += [("coulomb_friction", span) for span in SPANS[1:]]


@pytest.mark.parametrize(("name", "interval_s"), CARRIED)
def test_carried_signatures_are_slopes_of_the_fit(name: str, interval_s: tuple[float, float]):
    fit = fit_of(SHORT)
    fit = replace(fit, model=replace(fit.model, delay_s=1e-3))
    fit = fit.with_named([named(fit, name, interval_s)])
    tables, x = fit.model.signatures(0), fit.coefficients
    assert len(tables) == len(x) == len(fit.prior_std)
    own = range(fit.dtheta.size + 1, len(x))
    for k in (0, 33, 60, 70, *own):
        # θ and delay are linear, so only rounding limits their step
        h = np.zeros(len(x))
        h[k] = 1e-3 * fit.prior_std[k] if k in own else fit.prior_std[k]
        slope = (fit.at(x + h).model.predicted(0) - fit.at(x - h).model.predicted(0)) / (2 * h[k])
        size = np.sqrt(np.mean(slope**2)) + 1e-9
        room = 0.02 if k in own else 0.06  # a delay and a gain multiply, an offset moves the arm
        assert np.sqrt(np.mean((tables[k] - slope) ** 2)) < room * size, (name, k)


SHORT = recording(2)

# ---------------------------------------------------------------- the fit


def test_prior_of_theta_is_a_share_of_its_size():
    prior = theta_prior(ARM.theta, 0.02)
    assert np.all(prior >= 0.02 * np.abs(ARM.theta))
    assert np.all(prior > 0.0)  # of a number that happens to be zero too
    assert np.allclose(theta_prior(ARM.theta, 0.1), 5.0 * prior)


def test_worth_is_a_ratio_of_marginal_likelihoods():
    fit = fit_of(SHORT)
    fit, carried = refitted(fit.with_named([named(fit, "coulomb_friction")]).with_noise())
    own, rest = beside(fit, 0)
    thin = slice(None, None, 4)  # a covariance of all rows is large
    part = Carried(carried.N[:, thin], carried.prior_std, carried.data[thin])
    found = worth(fit, part, 0)
    both = covariance((part.N, part.prior_std))
    others = covariance((part.N[rest], part.prior_std[rest]))
    expected = log_likelihood(part.data, both) - log_likelihood(part.data, others)
    assert list(own) == list(place_of(fit, 0)) == [len(fit.coefficients) - 1]
    assert found.log_evidence == pytest.approx(expected, rel=1e-5, abs=1e-3)


def test_a_refit_finds_what_was_planted():
    pulls = []
    for seed in range(6):
        fit = fit_of(recording(10 + seed))
        there = next(c for c in _frictions(fit) if c.joint == RUBS)
        fit = fit.with_named([Named(there, np.array([0.2]))])
        fit, _ = refitted(fit)
        fit, carried = refitted(fit.with_noise())
        std = parameter_std(fit, carried.covariance(), 0)["Fc"]
        pulls.append((fit.named[0].values["Fc"] - FC) / std)
        assert std < 0.05 * FC
    assert np.abs(pulls).max() < 4.5
    assert np.sqrt(np.mean(np.square(pulls))) < 2.5


def test_what_friction_lacks_where_it_turns_round_is_no_noise():
    """And a sensor's low-pass, which smooths those jumps, is not in doubt for it."""
    fit = fit_of(SHORT)
    there = next(c for c in _frictions(fit) if c.joint == RUBS)
    fit, _ = refitted(fit.with_named([Named(there, np.array([FC]))]))
    fit = fit.with_noise().with_noise()
    level, lacks = fit.noise[0].level[RUBS], np.sqrt(fit.doubts[0])
    turns = lacks > 5.0 * level
    struck = fit.model.residual(0) + 0.3 * turns * lacks
    (found,) = fit.noise_of([struck])
    assert turns.sum() > 20 and found.level[RUBS] < 1.6 * level < 0.5 * noise_of(struck).level[RUBS]
    (nowhere,) = replace(fit, doubts=(fit.doubts[0] + 1e3,)).noise_of([struck])  # certain of none
    np.testing.assert_allclose(nowhere.level, noise_of(struck).level, rtol=0.01)
    filtered = fit.with_named([*fit.named, named(fit, "torque_filter")]).model
    own = filtered.named[1].candidate.effect.inexact * np.abs(filtered.contribution(0, 1))
    np.testing.assert_allclose(unsure(filtered, 0, 1), own)


def test_bodies_that_cannot_exist_give_way_where_torques_do_not_show_it():
    fit, carried = refitted(fit_of(SHORT))
    x = fit.coefficients
    x[4] -= 2.0 * ARM.theta[0, 4]  # XX of link 1, which turns about z
    asked = fit.at(x)
    found = possible(asked, carried)
    assert is_consistent(ARM.theta + found.dtheta)
    assert not is_consistent(ARM.theta + asked.dtheta)
    assert np.abs(found.model.residual(0) - asked.model.residual(0)).max() < 0.1 * TAU_NOISE
    assert possible(found, carried) is found


def test_a_payload_that_cannot_exist_gives_way_as_little_as_the_data_let_it():
    """Of all that can exist, nothing is nearer to what the data say."""
    fit = fit_of(SHORT)
    nothing = replace(named(fit, "payload"), x=np.zeros(10), interval_s=(3.0, np.inf))
    fit, carried = refitted(fit.with_named([nothing]))
    right, off = fit.coefficients, np.zeros(len(fit.coefficients))
    off[-6] = -1.5 * ARM.theta[-1, 4]  # XX of the payload
    asked = fit.at(right + off)
    found = possible(asked, carried)
    assert is_consistent(ARM.theta[-1] + found.dtheta[-1] + found.named[0].x)
    information = carried.G + np.diag(carried.prior_std**-2.0)
    way, back = found.coefficients - asked.coefficients, right - found.coefficients
    assert way @ information @ way < 0.9 * (off @ information @ off)
    assert way @ information @ back > 0.0  # the nearest point of a convex set


def sticking(seed: int) -> Fit:
    """A slow arm; friction holds one joint, at any torque up to its size, where it is slowest."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 12.0, 1e-3)
    q, dq, ddq = DRAWN.at(1.0 + 0.3 * t)
    dq, ddq = 0.3 * dq, 0.09 * ddq
    v, tau = dq[:, RUBS], ARM.torque(q, dq, ddq)
    held = np.repeat(rng.uniform(-1.0, 1.0, len(v) // 100 + 1), 100)[: len(v)]
    tau[:, RUBS] += FC * np.where(np.abs(v) < 0.02, held, np.sign(v))
    return fit_of(recorded(noisy(tau, TAU_NOISE, seed), t, q, dq))


def test_rows_in_which_a_joint_sticks_do_not_pull_at_its_friction():
    for seed in range(3):
        fit = sticking(seed)
        there = next(c for c in _frictions(fit) if c.joint == RUBS)
        found, _ = under_own_noise(fit.with_named([Named(there, np.array([FC]))]))
        assert abs(found.named[0].values["Fc"] / FC - 1.0) < 0.03


def test_a_rest_is_one_unknown_value_however_long_it_lasts():
    """A joint that swings, rests for five seconds, and swings on."""
    t = np.arange(0.0, 15.0, 1e-3)
    q, dq = (np.zeros((len(t), len(ARM.theta))) for _ in range(2))
    moves = (t < 5.0) | (t > 10.0)
    q[:, RUBS] = np.where(moves, 0.5 * (1.0 - np.cos(0.4 * np.pi * t)), 0.0)
    dq[:, RUBS] = np.where(moves, 0.2 * np.pi * np.sin(0.4 * np.pi * t), 0.0)
    own = prepare(recorded(noisy(np.zeros_like(q), TAU_NOISE, 1), t, q, dq), ARM)
    slowness = own.slowness[:, RUBS]
    rest = AT_REST * np.sqrt(5.0 * 25.0)
    assert slowness[(own.t > 6.0) & (own.t < 9.0)] == pytest.approx(rest, rel=0.1)
    sliding = np.abs(own.low(own.motion.dq)[:, RUBS]) > 0.2
    assert sliding.sum() > 50 and slowness[sliding].max() < 1e-3


def _frictions(fit: Fit) -> list:
    found = signatures(stages_of(fit.recordings[0], ()), EVERYWHERE)[1]
    return [c for c in found if c.effect.name == "coulomb_friction"]


# ---------------------------------------------------------------- the scan


def test_effects_that_act_all_the_time_are_scored_by_brute_force(field: SignatureTable):
    leads = {lead.candidate.key: lead for lead in field.whole()}
    for key in (("coulomb_friction", RUBS), ("motor_inertia", 1), ("base_tilt", -1)):
        lead = leads[key]
        X = field.X[list(lead.candidate.columns)]
        found = score(*field.carried.without(X), lead.candidate.prior_std)
        assert lead.log_evidence == pytest.approx(
            found.log_evidence + log_odds(lead.candidate), abs=1e-6
        )
        assert np.allclose(lead.x, found.x)


def gated(
    field: SignatureTable, columns: tuple[int, ...], begin: float, end: float = np.inf
) -> Array:
    """White signatures without the rows outside an interval."""
    t = np.repeat(np.concatenate(field.times), N)
    return field.X[list(columns)] * ((t >= begin) & (t < end))


@pytest.mark.parametrize("key", [("coulomb_friction", RUBS), ("torque_offset", 0), ("payload", -1)])
def test_running_sums_are_sums(key: tuple[str, int], field: SignatureTable):
    c = next(c for c in field.candidates if c.key == key)
    t, margin = field.times[0], 2 * BLOCK_S
    starts = np.arange(t[0], t[-1], SUDDEN_S if c.effect.sudden else BLOCK_S)
    starts = starts[(starts > t[0] + margin) & (starts < t[-1] - margin)]
    gates = (gated(field, c.columns, begin) for begin in starts)
    each = [score(*field.carried.without(gate), c.prior_std) for gate in gates]
    best = int(np.argmax([x.log_evidence for x in each]))
    lead = field.timed([c])[0]
    assert lead.interval_s == (pytest.approx(starts[best]), np.inf)
    expected = each[best].log_evidence + log_odds(c, timed=True) - np.log(len(starts))
    assert lead.log_evidence == pytest.approx(expected, abs=1e-5)
    assert lead.chi2 == pytest.approx(each[best].chi2, rel=1e-6)
    assert np.allclose(lead.x, each[best].x, rtol=1e-5, atol=1e-8)


def test_differences_of_running_sums_are_sums(field: SignatureTable):
    c = next(c for c in field.candidates if c.key == ("external_wrench", -1))
    lead = field.passing([c])[0]
    begin, end = lead.interval_s
    assert 0.0 < end - begin < 8.5
    direct = score(*field.carried.without(gated(field, c.columns, begin, end)), c.prior_std)
    assert lead.chi2 == pytest.approx(direct.chi2, rel=1e-5)
    assert np.allclose(lead.x, direct.x, rtol=1e-4, atol=1e-6)


def test_an_honest_lead_is_what_it_says_together_with_none(field: SignatureTable):
    own = next(x for x in field.whole() if x.candidate.key == ("coulomb_friction", RUBS))
    honest, alone = field.honest(own), field.together([own])
    assert honest.log_evidence == pytest.approx(alone.log_evidence + own.odds)
    assert honest.x[0] == pytest.approx(FC, rel=0.1)
    assert honest.log_evidence > BELIEF
    # what leaves the friction in its noise cannot claim what the friction can
    other = next(x for x in field.whole() if x.candidate.key == ("torque_offset", RUBS))
    assert field.honest(other).log_evidence < honest.log_evidence


def test_the_best_move_is_what_was_planted(field: SignatureTable):
    first = honest_moves(field, set())[0].leads[0].candidate
    assert first.key == ("coulomb_friction", RUBS)


def test_noise_gives_no_move():
    """Hundreds of such recordings: `make trials`."""
    fit = fit_of(recording(21, friction=0.0))
    fit, _ = refitted(fit)
    assert honest_moves(SignatureTable(fit, EVERYWHERE), set()) == []


def test_a_simpler_name_is_no_rival_where_it_was_tried_and_gave_way():
    candidates = {
        name: Candidate(CATALOGUE[name], CATALOGUE[name].templates()[0], RUBS, (0,), 0.0)
        for name in ("coulomb_friction", "stribeck_friction", "viscous_friction")
    }
    plain, fine, other = candidates.values()
    rivals = [Rival(c, 99.0, 199.0, 1.0, np.ones(1), True) for c in (plain, other)]
    own = Standing(fine, 100.0, 200.0, tuple(rivals))
    assert own.gain(rivals[0]) == np.inf and own.probability == pytest.approx(0.0, abs=1e-9)
    own = replace(own, tried=frozenset({plain.key, other.key}))
    assert own.gain(rivals[0]) == -np.inf and own.gain(rivals[1]) == pytest.approx(-1.0)


def test_rivals_explain_a_share_between_nothing_and_all():
    fit = fit_of(SHORT)
    there = next(c for c in _frictions(fit) if c.joint == RUBS)
    fit, carried = refitted(fit.with_named([Named(there, np.array([FC]))]))
    fit, carried = refitted(fit.with_noise())
    (found,) = standings(fit, carried, SignatureTable(fit, EVERYWHERE, rich=False))
    shares = {r.candidate.key: r.overlap for r in found.rivals}
    assert all(-1e-6 <= x <= 1.0 + 1e-6 for x in shares.values())
    assert shares["asymmetric_friction", RUBS] > 0.99  # its finer form can do all that it can
    assert shares["viscous_friction", RUBS] > shares["viscous_friction", 0]
    assert shares["coulomb_friction", 0] < 0.2
    assert found.probability > 0.9


def test_patterns_hold_every_smooth_curve_of_their_signal(signals: Signals):
    motion, tau = (
        signals.motion,
        ARM.torque(signals.motion.q, signals.motion.dq, signals.motion.ddq),
    )
    x = motion.dq[:, RUBS]
    curve = next(p for p in patterns(RUBS) if p.depends_on == (f"dq{RUBS + 1}",))
    basis = np.column_stack(
        [curve.torque(motion, tau, RUBS, {"x": unit})[:, RUBS] for unit in np.eye(8)]
    )
    for shape in (np.ones_like(x), x, x**2, x**3, np.tanh(x)):
        left = shape - basis @ np.linalg.lstsq(basis, shape, rcond=None)[0]
        assert np.abs(left).max() < 0.02 * np.abs(shape).max()


def test_pattern_tables_look_at_patterns_alone():
    found = SignatureTable(fit_of(SHORT), (RUBS,), PATTERNS)
    assert {c.joint for c in found.candidates} == {RUBS}
    assert not {c.effect.name for c in found.candidates} & set(CATALOGUE)
