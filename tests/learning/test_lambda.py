"""λ comes back: from synthesized link motion (the documentation) and from measured (a bent arm)."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from adapter.learning.learner import OnlineLearner
from adapter.model.self_model import LAMBDA_MEASURED, LAMBDA_REPRODUCED
from adapter.model.spatial import log_rotation, matrix_from_zxz
from adapter.physics.identifiability import FrameObservability, frame_observability
from adapter.runs.outcome import collect, frame_errors, learned_model
from adapter.signals.records import stamp_of
from sim.truth import Truth
from tests.helpers.arm_data import (
    LINK_TWIST_NOISE,
    ArmData,
    Motion,
    arm,
    bent,
    learner_for,
    panda_model,
    record,
    states_of,
)

SEEDS = range(2)
ROTATION_RAD, POSITION_M = 0.01, 0.005
SECONDS = 4.0
KINDS = ("synthesized", "measured")


@dataclass
class Run:
    """A learner at the end of a log, and how far off it was on the way."""

    learner: OnlineLearner
    truth: Truth
    seen: FrameObservability
    time_s: np.ndarray
    turn: np.ndarray
    shift: np.ndarray

    def inside_for_good_s(self) -> float:
        """Log time from which all joints stay inside the goal; inf where they don't."""
        good = (self.turn < ROTATION_RAD).all(axis=1) & (self.shift < POSITION_M).all(axis=1)
        bad = np.flatnonzero(~good)
        last = bad[-1] if len(bad) else -1
        return float(self.time_s[last + 1]) if last + 1 < len(good) else np.inf


def data_of(kind: str, seed: int) -> ArmData:
    truth = arm() if kind == "synthesized" else bent(seed)
    return record(truth, Motion(SECONDS, seed), links=kind == "measured")


def learn(data: ArmData, mode: str = "moments", seed: int = 0) -> Run:
    """Learn λ alone from a recording, sample by sample."""
    learner = learner_for(mode=mode, seed=seed)
    truth, model = data.truth, panda_model()
    kept = []
    for count, state in enumerate(states_of(data), 1):
        learner.learn_schema(state[None])
        if count % 10 == 0:
            kept.append((1e-9 * stamp_of(state), learner.schema.lam))
    times, values = (np.array(x) for x in zip(*kept, strict=True))
    seen = frame_observability(model.tree, truth.lam, model.gravity)
    turn, shift = frame_errors(values, truth.lam, seen.freedom)
    return Run(learner, truth, seen, times, turn, shift)


@cache
def run(kind: str, seed: int, mode: str = "moments") -> Run:
    return learn(data_of(kind, seed), mode, seed)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("kind", "within_s"), [("synthesized", 1.6), ("measured", 3.2)])
def test_lambda_comes_back_and_stays(kind: str, within_s: float, seed: int) -> None:
    """Motion starts softly after 0.1 s of log; then 1.5 and 3 s."""
    found = run(kind, seed)
    assert found.inside_for_good_s() < within_s
    assert found.learner.schema.converged
    assert found.learner.schema.rank == found.seen.rank


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_not_shown_stays_at_the_start(kind: str, seed: int) -> None:
    """Nothing ever shows where joint 1 stands, or its turn about gravity; nor joint 2's height."""
    learner, start = run(kind, seed).learner, run(kind, seed).learner.schema.start_lam
    outcome = collect(learner)
    assert np.array_equal(learner.schema.p[0], start[0, 3:])
    # noise tilts what is found to be shown of joint 2 a little
    slack = 1e-12 if kind == "synthesized" else 1e-3
    assert learner.schema.p[1, 2] == pytest.approx(start[1, 5], abs=slack)
    assert np.abs(outcome.lam_covariance[0, 3:]).max() == 0.0
    model, measured = learned_model(outcome, panda_model()), kind == "measured"
    assert model.lambda_source == (LAMBDA_MEASURED if measured else LAMBDA_REPRODUCED)
    assert outcome.lam_measured is measured
    assert not model.lam_identifiable[0, 2:].any()
    assert model.lam_identifiable[0, :2].all()
    assert not model.lam_identifiable[1, 5]
    assert np.isnan(model.lam_std[~model.lam_identifiable]).all()
    assert np.isfinite(model.lam_std[model.lam_identifiable]).all()
    assert model.lam_identifiable[2:].all()


@pytest.mark.parametrize("seed", SEEDS)
def test_standard_deviations_are_of_the_size_of_the_errors(seed: int) -> None:
    """Squared z-scores of a joint's shown directions add up to about their number."""
    found = run("measured", seed)
    schema = found.learner.schema
    R = matrix_from_zxz(found.truth.lam[:, :3])
    turn = log_rotation(np.swapaxes(R, 1, 2) @ schema.R0)
    error = np.concatenate([turn, schema.p - found.truth.lam[:, 3:]], axis=1)
    total, count = 0.0, 0
    for e, information, shown in zip(error, schema.information, schema.identifiable, strict=True):
        part = shown @ e
        total += part @ information @ part
        count += round(np.trace(shown))
    assert count == found.seen.rank
    assert 0.5 < total / count < 1.6


@pytest.mark.parametrize("kind", KINDS)
def test_mode_sample_runs_and_is_worse(kind: str) -> None:
    ours, theirs = run(kind, 0), run(kind, 0, "sample")
    lam = theirs.learner.schema.lam
    assert np.isfinite(lam).all()
    assert theirs.turn[-1].max() > 10.0 * ours.turn[-1].max()
    start, *_ = frame_errors(theirs.learner.schema.start_lam, ours.truth.lam, ours.seen.freedom)
    assert theirs.turn[-1].mean() < start.mean()


def test_a_hole_in_the_data_is_not_taken_for_noise() -> None:
    """50 ms lost in fast motion, and the filter's settling with them."""
    data = data_of("measured", 0)
    rows = np.r_[:2500, 2550 : len(data)]
    names = ("stamp_ns", "q", "dq", "tau", "twists", "accels")
    holed = replace(data, **{name: getattr(data, name)[rows] for name in names})
    found = learn(holed)
    assert found.learner.schema.rank == found.seen.rank
    assert found.turn[-1].max() < ROTATION_RAD and found.shift[-1].max() < POSITION_M
    w_noise = np.sqrt(found.learner.schema.noise_variance()[:-1, 1])
    assert (w_noise < 1.3 * LINK_TWIST_NOISE).all()


def test_measured_motion_counts_although_it_comes_late() -> None:
    """Link sensors that start after the joints': λ is still the measured one."""
    data = data_of("measured", 0)
    twists, accels = data.twists.copy(), data.accels.copy()
    twists[:300] = accels[:300] = np.nan
    found = learn(replace(data, twists=twists, accels=accels))
    assert collect(found.learner).lam_measured
    assert found.inside_for_good_s() < SECONDS


@pytest.mark.parametrize("kind", KINDS)
def test_runs_repeat_bit_for_bit_and_depend_on_the_seed(kind: str) -> None:
    short = data_of(kind, 0).part(1.0)
    first, again = learn(short), learn(short)
    other = learn(short, seed=1)
    assert first.learner.schema.lam.tobytes() == again.learner.schema.lam.tobytes()
    assert not np.array_equal(first.learner.schema.start_lam, other.learner.schema.start_lam)


@pytest.mark.parametrize("gravity", [(9.81, 0.0, 0.0), (0.0, 0.0, 9.81)])
def test_on_a_wall_and_under_a_ceiling(gravity: tuple[float, float, float]) -> None:
    truth = arm().with_changes(gravity=np.array(gravity))
    model = replace(panda_model(), gravity=np.array(gravity))
    learner = learner_for(model)
    for state in states_of(record(truth, Motion(2.5, 3)), model):
        learner.learn_schema(state[None])
    seen = frame_observability(model.tree, model.lam, model.gravity)
    turn, shift = frame_errors(learner.schema.lam, model.lam, seen.freedom)
    assert learner.schema.rank == seen.rank
    assert turn.max() < ROTATION_RAD and shift.max() < POSITION_M
