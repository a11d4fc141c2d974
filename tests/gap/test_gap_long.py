"""Recordings that are too long to be held at once: pieces against the whole, changes, names."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from adapter.gap.changes import Windows, loaded, with_changes
from adapter.gap.fit import Fit, Model
from adapter.gap.held_out import moments_of
from adapter.gap.long_recording import RATE_HZ, LongRecording, Survey, is_long
from adapter.gap.real_arm import as_driven, nominal_fit, real_arm
from adapter.gap.signals import KNOT_S, Recorded, Signals, Splines, on_grid
from adapter.gap.workflow import find_gap
from adapter.model.robots import documented
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import Log, mapped
from tests.helpers.long_arm import DRIFTING, LOAD_KG, Hidden, log_of

SECONDS, HZ = 96.0, 200
JOINTS = tuple(range(7))


@cache
def log(hidden: bool = False) -> Log:
    return log_of(SECONDS, Hidden(SECONDS) if hidden else None, HZ)


@cache
def whole() -> LongRecording:
    return LongRecording.through(Survey.of(log()), "a")


def arm() -> RigidArm:
    return RigidArm.of(documented("panda"))


def at_once() -> Signals:
    """The recording through one spline, in one."""
    own, run = Recorded.of(log(), whole().dq_late_s), whole().runs[0]
    like = whole().taking([(0.0, SECONDS)]).signals(arm())
    t = run.begin_s + np.arange(len(like.motion.t)) / RATE_HZ
    knots = KNOT_S * np.arange(int(np.ceil(own.t[-1] / KNOT_S)) + 1)
    splines = Splines.through(own.t, own.q, own.dq, whole().dq_late_s, knots)
    q, dq, ddq = splines.smoothed(whole().smoothness).at(t)
    motion = replace(like.motion, t=t, q=q, dq=dq, ddq=ddq)
    tau = replace(like, motion=motion).low(on_grid(t, own.t, own.tau))
    return replace(like, motion=motion, tau=tau)


def test_pieces_are_the_whole_to_rounding() -> None:
    one = at_once()
    pieces = whole().taking([(0.0, SECONDS)]).signals(arm())
    np.testing.assert_allclose(pieces.motion.q, one.motion.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(pieces.motion.dq, one.motion.dq, rtol=0, atol=1e-10)
    np.testing.assert_allclose(pieces.motion.ddq, one.motion.ddq, rtol=0, atol=1e-8)
    np.testing.assert_allclose(pieces.tau, one.tau, rtol=0, atol=1e-9)
    assert np.array_equal(pieces.t, one.t)


def test_moments_of_pieces_are_those_of_the_whole_within_a_fraction_of_a_deviation() -> None:
    nominal = nominal_fit([whole()], documented("panda"), 0.02, 1.0 / HZ)
    fit = as_driven(nominal, JOINTS, ()).with_noise()
    known = moments_of(fit, whole())
    one = at_once()
    model = Model((one,), fit.dtheta, named=fit.named, hand=fit.model.hand)
    exact = Fit(model, fit.prior, fit.noise, fit.timing_std_s).with_noise(fit.noise).carried()
    assert np.abs((known.x - exact.x) / exact.std()).max() < 0.5
    np.testing.assert_allclose(known.std(), exact.std(), rtol=0.1)


def test_what_was_left_out_does_not_pass_for_motion() -> None:
    """Stretches are looked at apart: each one's rows are those of that stretch alone."""
    spans = [(5.0, 12.0), (40.0, 46.0), (80.0, 88.0)]
    both = whole().taking(spans).signals(arm())
    single = [whole().taking([span]).signals(arm()) for span in spans]
    np.testing.assert_array_equal(both.tau, np.concatenate([x.tau for x in single]))
    regressors = np.concatenate([x.low_regressor for x in single], axis=1)
    np.testing.assert_array_equal(both.low_regressor, regressors)


def test_stretches_are_spread_and_move() -> None:
    spans = whole().survey.spread(whole().span)
    assert len(spans) == 6 and spans[0][0] < 0.2 * SECONDS and spans[-1][1] > 0.8 * SECONDS


def test_a_load_picked_up_is_found_and_dated_in_all_of_it() -> None:
    hidden, model = Hidden(SECONDS), documented("panda")
    sampled = with_changes(LongRecording.through(Survey.of(log(hidden=True)), "a"), model, 0.02)
    assert any(abs(t - hidden.changed_s) < 3.0 for t in sampled.loads_s), sampled.loads_s
    assert any(a < hidden.pushed_s + 1.5 < b for a, b in sampled.spans), sampled.spans
    nominal = nominal_fit([sampled], model, 0.02, 1.0 / HZ)
    fit = loaded(nominal, JOINTS, sampled.loads_s)
    dated = {e.interval_s[0]: e.x[0] for e in fit.named}
    begin = min(dated, key=lambda t: abs(t - hidden.changed_s))
    assert abs(begin - hidden.changed_s) < 0.15
    assert abs(dated[begin] - LOAD_KG) < 0.1


def test_nothing_changes_where_nothing_does() -> None:
    nominal = nominal_fit([whole()], documented("panda"), 0.02, 1.0 / HZ)
    fit = real_arm(nominal, JOINTS, (0,)).fit.with_noise()
    assert Windows.of(fit, whole()).loads_s == []


@pytest.mark.slow
@pytest.mark.parametrize("holds", [False, True])
@pytest.mark.parametrize("seed", [3, 7])
def test_what_is_hidden_in_a_long_recording_is_named_and_dated(seed: int, holds: bool) -> None:
    hidden = Hidden(SECONDS, holds)
    made = log_of(SECONDS, hidden, HZ, seed)
    own = mapped(made, made.pieces(5000))
    assert is_long(own)
    result = find_gap([own], documented("panda"))
    loads = [f for f in result.findings if f.effect == "payload"]
    change = max(loads, key=lambda f: f.interval_s[0])
    assert len(loads) == 1 + holds and abs(change.interval_s[0] - hidden.changed_s) < 0.2
    sign = -1.0 if holds else 1.0
    assert abs(change.parameters["m"] - sign * LOAD_KG) < 4.0 * change.std["m"]
    drift = next(f for f in result.findings if f.effect == "friction_drift")
    assert drift.joints == (DRIFTING + 1,)
    assert abs(drift.parameters["dFc"] - hidden.drift) < 4.0 * drift.std["dFc"]
    (sampled,) = result.sampled
    assert sampled["searched_s"] < 60.0 < sampled["seconds"] and sampled["weighed_on_all"]
