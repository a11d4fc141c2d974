"""Recordings in a file: what is learned from them piece by piece, and from every k-th state."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.linalg

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.learning.settings import LearnerSettings
from adapter.runs import batch
from adapter.runs.config import PipelineSettings
from adapter.runs.replay import (
    Replay,
    ReplayOptions,
    from_s,
    held_out_rms,
    last_s,
    noise_levels,
    one_after_other,
    replay,
)
from adapter.signals import validation
from adapter.signals.matching import matching, most_moved
from drivers.files.mcap import Log, mapped
from drivers.interface import Array
from tests.helpers.arm_data import panda_model
from tests.helpers.long_arm import log_of

SETTINGS = PipelineSettings(learner=LearnerSettings(effects=REAL_ARM_EFFECTS))


@cache
def moving(seconds: float, seed: int) -> Log:
    """The documented arm with friction on three sines a joint, and the sensors' noise."""
    return log_of(seconds, seed=seed)


def in_file(log: Log) -> Log:
    return mapped(log, log.pieces(3_000))


def information(found: Replay, like: Replay) -> tuple[Array, Array]:
    """Of the parameters in use, and their most probable values, under the prior of one alike.

    What spreads the joints' numbers are taken to have is learned, and hangs on the last bit.
    """
    theta, prior = found.pipeline.learner.theta, like.pipeline.learner.theta
    H, rhs = theta.information()
    H, rhs = H - theta.prior + prior.prior, rhs - theta.prior_rhs + prior.prior_rhs
    known = theta.known()
    H, rhs = H[np.ix_(known, known)], rhs[known]
    return H, np.linalg.solve(H, rhs)


@pytest.mark.parametrize("seed", [1, 2])
def test_every_kth_state_tells_what_all_tell(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """θ, its standard deviations and the noise, against all states of the same recording."""
    log = moving(12.0, seed)
    thin = replay(log, panda_model(), SETTINGS, ReplayOptions(every=50))
    monkeypatch.setattr(batch, "PER_SAMPLE", 10**6)
    dense = replay(log, panda_model(), SETTINGS, ReplayOptions(every=50))
    assert thin.outcome.learned == dense.outcome.learned
    (H, th), (G, other) = information(dense, dense), information(thin, dense)
    weights, vectors = np.linalg.eigh(H)
    off = np.sqrt(weights) * (vectors.T @ (other - th))  # standard deviations
    assert np.sqrt(np.mean(off**2)) < 0.3 and np.abs(off).max() < 1.0
    share = scipy.linalg.eigvalsh(G, H)
    assert abs(np.median(share) - 1.0) < 0.1
    assert thin.outcome.theta_excess < 1.03
    assert thin.outcome.variance == pytest.approx(dense.outcome.variance, rel=0.15)
    std = np.sqrt(dense.outcome.covariance.diagonal()).reshape(-1, 10)
    assert (np.abs(thin.outcome.theta - dense.outcome.theta) < 2.0 * std + 1e-9).all()
    assert thin.pipeline.learner.theta.weight == 1.0  # what comes next counts for itself


@pytest.mark.parametrize("every", [1, 50])
def test_a_recording_in_a_file_teaches_what_it_teaches_in_memory(every: int) -> None:
    log = moving(3.0, 1)
    options = ReplayOptions(every, until_s=2.5)
    ours = replay(in_file(log), panda_model(), SETTINGS, options)
    theirs = replay(log, panda_model(), SETTINGS, options)
    assert (ours.samples, ours.span_s) == (theirs.samples, theirs.span_s)
    for name in ("lam", "theta", "effects", "covariance", "score_trace"):
        assert np.array_equal(getattr(ours.outcome, name), getattr(theirs.outcome, name)), name


def test_held_out_error_by_windows_is_that_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "WINDOW_S", 5.3)
    log = moving(12.0, 1)
    rng = np.random.default_rng(5)
    kept = rng.random(len(log)) > 0.05  # samples are missing, one repeats, one is late
    kept[4_000:4_700] = False
    log = log.take(kept)
    log.q[900], log.dq[900], log.tau[900] = log.q[899], log.dq[899], log.tau[899]
    log.stamp_ns[2_000] -= 5_000_000
    ours = held_out_rms(in_file(log), panda_model(), SETTINGS)
    theirs = held_out_rms(log, panda_model(), SETTINGS)
    assert ours.value == pytest.approx(theirs.value, rel=1e-9)


def test_parts_of_a_recording_in_a_file() -> None:
    log = moving(12.0, 1)
    whole = in_file(log)
    assert last_s(whole) == last_s(log) == pytest.approx(11.999)
    late, theirs = from_s(whole, 8.0), from_s(log, 8.0)
    assert late.is_mapped and np.array_equal(late.tau, theirs.tau)
    for name, level in noise_levels(whole).items():
        assert level == pytest.approx(noise_levels(log)[name], rel=0.1)
    assert len(most_moved(whole)) == len(log)
    mixed = replace(log, joint_names=tuple(reversed(log.joint_names)))
    assert np.array_equal(matching(in_file(mixed), panda_model()).q, log.q[:, ::-1])


def test_recordings_one_after_the_other_in_a_file() -> None:
    log = moving(3.0, 1)
    ours, theirs = one_after_other([in_file(log), log]), one_after_other([log, log])
    assert ours.is_mapped and not theirs.is_mapped
    assert np.array_equal(ours.stamp_ns, theirs.stamp_ns) and np.array_equal(ours.q, theirs.q)
