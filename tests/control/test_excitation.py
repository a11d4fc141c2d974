"""The random motion keeps every limit, whenever it stops; the controller those of the torque.

What a plan says of pushes is compared with the torques of a force at the hand by Pinocchio.
"""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.excitation import RandomMotion, plan_lines
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.push_bound import PushBound, left_at_most, push_bound
from adapter.control.settings import ExcitationSettings, SafetySettings
from adapter.effects.robots import robot_urdf
from adapter.errors import SettingsError
from adapter.model.robots import documented
from sim.plant import SimulatedArm
from sim.scenarios import build
from tests.helpers.live_tools import check_course, played
from tests.helpers.robot_models import pin_model

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
DT = 2e-3
READY = build("nominal").truth.ready
NUMBERS = r"([+-][\d.]+) \.\. ([+-][\d.]+) rad .* at first ([\d.]+), then ([\d.]+) rad/s"


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    share=st.lists(st.floats(0.0, 1.0), min_size=7, max_size=7),
    stop_s=st.floats(0.0, 8.0),
    rest=st.one_of(st.none(), st.floats(0.0, 3.0)),
    slow=st.one_of(st.just(0.0), st.floats(1.0, 4.0)),
    slow_share=st.floats(0.01, 1.0),
)
def test_keeps_every_limit_for_every_seed_start_and_stop(
    seed, share, stop_s, rest, slow, slow_share
):
    shift = 0.0 if slow == 0.0 else slow + 1.0  # no rest while it becomes quicker
    rests = () if rest is None else ((shift + rest, shift + rest + 1.5),)
    start = LIMITS.lower + np.array(share) * (LIMITS.upper - LIMITS.lower)
    start = np.minimum(start, LIMITS.upper)  # rounding may lead a last bit beyond
    how = ExcitationSettings(seed=seed, rests=rests, slow_s=slow, slow_share=slow_share)
    motion = RandomMotion(LIMITS, start, how)
    q, dq, ddq = course = played(motion, stop_s, DT)
    check_course(motion, course, DT)
    assert (q >= LIMITS.lower - 1e-9).all() and (q <= LIMITS.upper + 1e-9).all()
    low, high = (
        np.minimum(LIMITS.lower + how.margin, start),
        np.maximum(LIMITS.upper - how.margin, start),
    )
    assert (q >= low - 1e-9).all() and (q <= high + 1e-9).all()  # further out only to begin with
    bounds = motion.bounds()
    assert (bounds[1] - bounds[0] <= how.range_share * (high - low) + 1e-9).all()
    assert (np.abs(dq) <= 0.95 * LIMITS.velocity).all()
    assert (np.abs(ddq) <= 0.95 * LIMITS.acceleration).all()
    assert (np.abs(np.diff(ddq, axis=0)) / DT <= LIMITS.jerk).all()
    # It starts from where the arm is and stands still in the end.
    np.testing.assert_allclose(q[0], q[1], atol=1e-6)
    assert (dq[-1] == 0.0).all()


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000), slow_share=st.floats(0.05, 0.5))
def test_a_slow_start_takes_the_same_path_at_a_share_of_the_speed(seed, slow_share):
    how = ExcitationSettings(seed=seed, slow_s=3.0, slow_share=slow_share)
    slow, full = (RandomMotion(LIMITS, READY, h) for h in (how, ExcitationSettings(seed=seed)))
    most = slow_share * full.bounds()[2]
    while slow.time_s < 3.0:
        slow.advance(DT)
        assert (np.abs(slow.dq) <= most + 1e-12).all()
    for _ in range(1000):
        slow.advance(DT)
    # At full speed it moves along the path of a motion that never was slow.
    gap = full._s - slow._s
    while gap < -1e-12:
        full.advance(min(-gap, DT) if full.time_s > 1.0 else DT)
        gap = full._s - slow._s
    np.testing.assert_allclose(full.q, slow.q, atol=1e-9)
    np.testing.assert_allclose(full.dq, slow.dq, atol=1e-9)


def test_a_plan_says_how_far_how_fast_and_how_to_stop():
    how = ExcitationSettings(seed=4, slow_s=10.0)
    motion = RandomMotion(LIMITS, READY, how)
    lines = plan_lines(motion, LIMITS, PANDA.tree.joint_names, 30.0)
    assert "7 joints, for 30 s and 1 s of coming to rest" in lines[0]
    assert "first 10 s go at 10% of the speed" in lines[1] and "Ctrl-C" in lines[-1]
    lowest, highest, fastest = np.full(7, np.inf), np.full(7, -np.inf), np.zeros(7)
    for _ in range(20_000):
        motion.advance(5e-3)
        lowest, highest = np.minimum(lowest, motion.q), np.maximum(highest, motion.q)
        fastest = np.maximum(fastest, np.abs(motion.dq))
    for j, name in enumerate(PANDA.tree.joint_names):
        (line,) = (line for line in lines if line.startswith(name))
        low, high, slow, fast = map(float, re.findall(NUMBERS, line)[0])
        assert low - 5e-4 <= lowest[j] and highest[j] <= high + 5e-4
        assert fastest[j] <= fast + 5e-4 and abs(slow - 0.1 * fast) < 2e-3
        assert high - low < 1.3 * (highest[j] - lowest[j]) and fast < 1.5 * fastest[j]
    endless = plan_lines(RandomMotion(LIMITS, READY), LIMITS, PANDA.tree.joint_names)
    assert "until somebody stops it" in endless[0] and "speed" not in endless[1]


def test_is_rich_and_does_not_repeat():
    motion = RandomMotion(LIMITS, READY, ExcitationSettings(seed=3))
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
    for wrong in ({"slow_s": 0.5}, {"slow_s": -1.0}, {"slow_share": 0.0}, {"slow_share": 2.0}):
        with pytest.raises(SettingsError, match="slow_s"):
            ExcitationSettings(**wrong)
    with pytest.raises(SettingsError, match=r"becomes quicker, 10\.0 to 11\.0 s"):
        ExcitationSettings(slow_s=10.0, rests=((10.5, 12.0),))
    with pytest.raises(SettingsError, match="7 joints"):
        ExcitationController(LIMITS, control=ControlSettings(stiffness=(1.0, 2.0)))


@pytest.mark.parametrize(
    ("scenario", "with_model"), [("nominal", True), ("friction", False), ("bent_link", True)]
)
def test_the_simulated_arm_follows(scenario, with_model):
    arm = SimulatedArm(build(scenario, seed=2).plant())
    arm.connect()
    feedforward = ModelFeedforward.of(PANDA) if with_model else None
    controller = ExcitationController(LIMITS, ExcitationSettings(seed=2), feedforward=feedforward)
    last = None
    for k in range(4000):
        sample = arm.read()
        if k == 2500:
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


def test_forces_at_the_hand_that_a_motion_is_ended_by() -> None:
    motion = RandomMotion(LIMITS, READY, ExcitationSettings(seed=3))
    safety = SafetySettings()
    bound = push_bound(PANDA, motion, LIMITS, safety)
    np.testing.assert_allclose(bound.joints, safety.external_share * LIMITS.effort)

    oracle, rng, stops = pin_model(robot_urdf(PANDA, alone=True).text), np.random.default_rng(5), []
    data = oracle.createData()
    for s in rng.uniform(0.0, 30.0, 300):
        q = motion.path(float(s))[0]
        jacobian = pin.computeJointJacobian(oracle, data, q, oracle.njoints - 1)
        turned = data.oMi[oracle.njoints - 1].rotation @ jacobian[:3]
        ways = rng.normal(size=(50, 3))
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        felt = np.maximum(np.abs(ways @ turned), 1e-9)
        stops.append((bound.joints / felt).min(axis=1))
    force = np.concatenate(stops)
    assert 0.85 < bound.most / force.max() < 1.1
    assert abs(np.mean(force < bound.middle) - 0.5) < 0.03
    first, last = bound.lines()
    assert f"{bound.middle:.0f} N for half" in first
    assert f"{bound.most:.0f} N for the worst" in first
    assert ", ".join(f"{x:.3g}" for x in left_at_most(LIMITS.effort)) in last


def test_a_push_that_no_joint_feels_is_said_in_words() -> None:
    one = np.ones(2)
    assert "way, no push does in the worst." in PushBound(one, 30.0, 1.4e6, one).lines()[0]
