"""What a plan says of pushes, against torques that Pinocchio says a force at the hand makes."""

import numpy as np
import pinocchio as pin

from adapter.control.excitation import RandomMotion
from adapter.control.limits import MotionLimits
from adapter.control.push_bound import PushBound, left_at_most, push_bound
from adapter.control.settings import ExcitationSettings, SafetySettings
from adapter.effects.export import to_urdf
from adapter.model.robots import documented
from sim.scenarios import build
from tests.helpers.robot_models import pin_model

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
READY = build("nominal").truth.ready


def test_forces_at_the_hand_that_a_motion_is_ended_by() -> None:
    motion = RandomMotion(LIMITS, READY, ExcitationSettings(seed=3))
    safety = SafetySettings()
    bound = push_bound(PANDA, motion, LIMITS, safety)
    np.testing.assert_allclose(bound.joints, safety.external_share * LIMITS.effort)

    oracle, rng, stops = pin_model(to_urdf(PANDA)), np.random.default_rng(5), []
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


def test_the_plan_says_both_bounds() -> None:
    motion = RandomMotion(LIMITS, READY, ExcitationSettings(seed=3))
    bound = push_bound(PANDA, motion, LIMITS, SafetySettings())
    first, last = bound.lines()
    assert f"{bound.middle:.0f} N for half" in first
    assert f"{bound.most:.0f} N for the worst" in first
    assert ", ".join(f"{x:.3g}" for x in left_at_most(LIMITS.effort)) in last


def test_a_push_that_no_joint_feels_is_said_in_words() -> None:
    one = np.ones(2)
    assert "way, no push does in the worst." in PushBound(one, 30.0, 1.4e6, one).lines()[0]
