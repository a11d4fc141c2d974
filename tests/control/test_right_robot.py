"""The right robot: limits of the arm that it is, complete ones, and the weight that it holds."""

from __future__ import annotations

from dataclasses import replace
from importlib import resources

import numpy as np
import pytest

from adapter.control.controller import ExcitationController
from adapter.control.excitation import RandomMotion
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits, another_robot, need_complete
from adapter.control.resting import check_resting_torque
from adapter.control.settings import REAL_SHARE, SLOW_S, ExcitationSettings, gentle
from adapter.errors import SettingsError
from adapter.model.robots import documented
from adapter.model.self_model import Limits
from adapter.model.urdf import model_from_urdf
from sim.scenarios import build

PANDA, FR3 = documented("panda"), documented("fr3")
READY = build("nominal").truth.ready


class Says:
    """What a controller has to know of an arm that says which robot it is."""

    adds_gravity, period_ns, delay_ns = True, 1_000_000, 1_000_000

    def __init__(self, robot: str) -> None:
        self.robot = robot


def _renamed(model, name):
    """The same arm by another name, in the way that a user's own URDF would have it."""
    text = (resources.files("adapter") / "model" / "robots" / f"{model.name}.urdf").read_text()
    return model_from_urdf(text.replace(f'name="{model.name}"', f'name="{name}"'))


@pytest.mark.parametrize("name", ["panda", "fr3", "my_cell"])
def test_an_arm_is_known_by_its_joints_and_their_limits_not_by_its_name(name):
    assert MotionLimits.of(_renamed(FR3, name)).robot == "fr3"
    assert MotionLimits.of(_renamed(PANDA, name)).robot == "panda"


def test_seven_joints_and_the_name_do_not_make_a_panda():
    lam = PANDA.lam.copy()
    lam[3, 3] += 0.1
    limits = MotionLimits.of(replace(PANDA, lam=lam))
    assert limits.robot == "" and (limits.acceleration < PANDA.limits.velocity * 3).all()


def test_the_vendors_limits_hold_where_a_file_is_wider():
    own = FR3.limits
    wide = Limits(own.lower - 1.0, own.upper + 1.0, 3.0 * own.velocity, 3.0 * own.effort)
    limits = MotionLimits.of(replace(FR3, limits=wide))  # its name is known yet
    np.testing.assert_array_equal(limits.velocity, FR3.limits.velocity)
    assert limits.lower[5] == 0.5445 and limits.upper[3] == -0.1518


@pytest.mark.parametrize("seed", range(5))
def test_random_motion_keeps_the_fr3s_speed_by_position(seed):
    limits = MotionLimits.of(FR3)
    start = limits.lower + np.random.default_rng(seed).random(7) * (limits.upper - limits.lower)
    motion = RandomMotion(limits, start, ExcitationSettings(seed=seed, range_share=0.95))
    # libfranka's table (rate_limiting.h), written out once more
    two_d = np.array([12.0, 5.17, 7.0, 8.0, 34.0, 11.0, 34.0])
    offset = np.array([0.3, 0.2, 0.2, 0.3, 0.35, 0.35, 0.35])
    upper = np.array([2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196])
    lower = np.array([-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196])
    for _ in range(8000):
        motion.advance(5e-3)
        up = np.sqrt(two_d * np.maximum(upper - motion.q, 0.0)) - offset
        down = np.sqrt(two_d * np.maximum(motion.q - lower, 0.0)) - offset
        assert (motion.dq <= np.maximum(np.minimum(FR3.limits.velocity, up), 1e-9)).all()
        assert (-motion.dq <= np.maximum(np.minimum(FR3.limits.velocity, down), 1e-9)).all()


def test_an_arm_that_says_it_is_another_robot_is_not_moved():
    controller = ExcitationController(MotionLimits.of(PANDA))
    with pytest.raises(SettingsError, match=r"robot fr3, .* of the robot panda; give --robot fr3"):
        controller.attend(Says("fr3"))
    controller.attend(Says("panda"))
    controller.attend(Says(""))  # an arm that cannot tell
    stranger = MotionLimits.of(replace(PANDA, lam=PANDA.lam[::-1].copy()))
    assert "of no robot that is known" in another_robot(Says("panda"), stranger)


@pytest.mark.parametrize("key", ["lower", "velocity", "effort"])
def test_an_arm_with_incomplete_limits_is_not_moved(key):
    values = getattr(PANDA.limits, key).copy()
    values[2] = np.nan
    need_complete(PANDA)
    with pytest.raises(SettingsError, match=rf"panda_joint3 \({key}\)"):
        need_complete(replace(PANDA, limits=replace(PANDA.limits, **{key: values})))


def test_no_setting_lifts_the_cap_of_speed_or_the_slow_start():
    for asked in ({"slow_s": 1.0}, {"slow_s": 20.0, "slow_share": 1.0}, {"share": 0.95}):
        got = gentle(ExcitationSettings(**asked))
        assert got.share <= REAL_SHARE and got.slow_s >= SLOW_S and got.slow_share <= 0.1
    slower = ExcitationSettings(share=0.2, slow_s=30.0, slow_share=0.05)
    assert gentle(slower) == slower


def _held(model, q, load_kg=0.0, com=(0.0, 0.0, 0.2)):
    """What an arm holds at rest, with a load on its hand."""
    theta = model.theta.copy()
    theta[-1, :4] += load_kg * np.r_[1.0, com]
    return ModelFeedforward.of(replace(model, theta=theta)).unbent(q)


POSES = [READY, np.array([0.4, -0.3, -0.6, -1.6, 0.5, 2.0, -1.0]), np.zeros(7) - 0.1]


@pytest.mark.parametrize("q", POSES, ids=str)
def test_an_arm_that_holds_its_weight_and_a_load_may_move(q):
    for load_kg in (0.0, 1.0, 4.0):
        for com in ((0.0, 0.0, 0.2), (0.1, -0.1, 0.15)):
            friction = 0.5 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
            check_resting_torque(PANDA, q, _held(PANDA, q, load_kg, com) + friction)
    check_resting_torque(FR3, q, _held(PANDA, q))  # two published models of nearly one body


@pytest.mark.parametrize("gravity", [(9.81, 0, 0), (0, 0, 9.81), (0, -9.81, 0)], ids=str)
def test_an_arm_that_is_mounted_otherwise_is_not_moved(gravity):
    tau = _held(replace(PANDA, gravity=np.array(gravity, float)), READY)
    with pytest.raises(SettingsError, match=r"at rest panda_joint\d holds .* where .*--gravity"):
        check_resting_torque(PANDA, READY, tau)
    check_resting_torque(replace(PANDA, gravity=np.array(gravity, float)), READY, tau)


def test_an_arm_that_measures_nothing_is_not_moved():
    with pytest.raises(SettingsError, match="does not measure"):
        check_resting_torque(PANDA, READY, np.full(7, np.nan))
