"""The random motion keeps every limit, whenever it stops; the controller those of the torque."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.controller import ControlError, ControlSettings, ExcitationController
from adapter.errors import SettingsError
from adapter.excitation import ExcitationSettings, MotionLimits, RandomMotion
from adapter.feedforward import ModelFeedforward
from adapter.urdf import read_urdf
from drivers.interface import JointSample
from drivers.pybullet_arm import PyBulletArm
from sim.scenarios import build

PANDA = read_urdf(resources.files("adapter") / "robots" / "panda.urdf")
LIMITS = MotionLimits.of(PANDA)
DT = 2e-3


def _starts(draw_share):
    start = LIMITS.lower + np.array(draw_share) * (LIMITS.upper - LIMITS.lower)
    return np.minimum(start, LIMITS.upper)  # rounding may lead a last bit beyond


shares = st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    share=shares,
    stop_s=st.floats(0.0, 8.0),
    rest=st.one_of(st.none(), st.floats(0.0, 3.0)),
)
def test_keeps_every_limit_for_every_seed_start_and_stop(seed, share, stop_s, rest):
    rests = () if rest is None else ((rest, rest + 1.5),)
    start = _starts(share)
    motion = RandomMotion(LIMITS, start, ExcitationSettings(seed=seed, rests=rests))
    q, dq, ddq = [start], [np.zeros(7)], [np.zeros(7)]
    while not motion.at_rest:
        if motion.time_s >= stop_s:
            motion.begin_stop()
        motion.advance(DT)
        for history, value in zip((q, dq, ddq), (motion.q, motion.dq, motion.ddq), strict=True):
            history.append(value)
    q, dq, ddq = (np.array(x) for x in (q, dq, ddq))
    assert (q >= LIMITS.lower - 1e-9).all() and (q <= LIMITS.upper + 1e-9).all()
    assert (np.abs(dq) <= 0.95 * LIMITS.velocity).all()
    assert (np.abs(ddq) <= 0.95 * LIMITS.acceleration).all()
    assert (np.abs(np.diff(ddq, axis=0)) / DT <= LIMITS.jerk).all()
    # It starts from where the arm is, is smooth, and stands still in the end.
    np.testing.assert_allclose(q[0], q[1], atol=1e-6)
    np.testing.assert_allclose(np.diff(q, axis=0) / DT, 0.5 * (dq[1:] + dq[:-1]), atol=1e-4)
    np.testing.assert_allclose(np.diff(dq, axis=0) / DT, 0.5 * (ddq[1:] + ddq[:-1]), atol=2e-2)
    assert (dq[-1] == 0.0).all()


def test_is_rich_and_does_not_repeat():
    motion = RandomMotion(LIMITS, build("nominal").truth.ready, ExcitationSettings(seed=3))
    path = []
    for _ in range(30_000):
        motion.advance(1e-2)
        path.append(np.concatenate([motion.q, motion.dq]))
    path = np.array(path)[200:]
    assert (np.ptp(path[:, :7], axis=0) > 0.8).all()
    assert (np.abs(path[:, 7:]).max(axis=0) > 0.7).all()
    window = path[:500, :7]
    for lag in range(500, len(path) - 500, 25):
        assert np.abs(path[lag : lag + 500, :7] - window).max() > 0.1


def test_settings_and_starts_that_cannot_be_are_refused():
    with pytest.raises(SettingsError, match="outside its range"):
        RandomMotion(LIMITS, np.full(7, 3.2))
    with pytest.raises(SettingsError, match="shorter than a stop"):
        ExcitationSettings(rests=((1.0, 1.2),))
    with pytest.raises(SettingsError, match="low_hz"):
        ExcitationSettings(low_hz=2.0)
    with pytest.raises(SettingsError, match="7 joints"):
        ExcitationController(LIMITS, control=ControlSettings(stiffness=(1.0, 2.0)))


@pytest.mark.parametrize("with_model", [False, True])
@pytest.mark.parametrize("scenario", ["nominal", "friction", "bent_link"])
def test_the_simulated_arm_follows(scenario, with_model):
    arm = PyBulletArm(build(scenario, seed=2).plant())
    arm.connect()
    feedforward = ModelFeedforward.of(PANDA) if with_model else None
    controller = ExcitationController(LIMITS, ExcitationSettings(seed=2), feedforward=feedforward)
    last = None
    for k in range(6000):
        sample = arm.read()
        if k == 4500:
            controller.begin_stop()
        tau = controller.step(sample)
        if last is not None:
            # 1000 N m/s; stamps carry no jitter here
            assert (np.abs(tau - last) <= 1.0 + 1e-9).all()
        assert (np.abs(tau) <= 0.95 * LIMITS.effort).all()
        arm.command(tau)
        last = tau
    assert controller.at_rest and np.abs(sample.dq).max() < 0.1
    tracking = controller.tracking()
    assert tracking["saturated"] == 0
    found = tracking["feedforward" if with_model else "feedback"]
    assert max(found["max_rad"]) < (0.06 if with_model else 0.1)
    if with_model and scenario == "nominal":
        assert max(found["rms_rad"]) < 0.002
    arm.close()


def test_blind_for_long_the_controller_gives_up():
    controller = ExcitationController(LIMITS)
    q = build("nominal").truth.ready
    good = JointSample(0, q, np.zeros(7), np.zeros(7))
    first = controller.step(good)
    bad = np.full(7, np.nan)
    np.testing.assert_array_equal(controller.step(JointSample(10**7, bad, bad, bad)), first)
    with pytest.raises(ControlError, match="no usable joint reading"):
        controller.step(JointSample(3 * 10**7, bad, bad, bad))
