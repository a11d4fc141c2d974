"""The vendor's clients, unmodified, against the simulated robot: panda-python and pylibfranka."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest

from sim.effects import payload
from sim.truth import FLANGE_M, documented, panda
from tests.helpers import fci_clients
from tests.helpers.arm_data import pin_model
from tests.helpers.fci_clients import TOLD

pytestmark = pytest.mark.alone

PROVOCATIONS = ("step", "pause", "too_far", "jerky")
SHARED = ("read", "torque", *PROVOCATIONS, "joints", "settings")
MODEL = {5: "panda_model", 10: "fr3_model"}


@dataclass(frozen=True)
class Visit:
    """One client at one robot: what it saw, by action, and the robot's summary."""

    protocol: int
    found: dict[str, dict]
    summary: dict

    def seen(self, action):
        """Of an action; where this machine held it up each time, nothing can be said of it."""
        found = self.found[action]
        assert "failed" not in found, found
        if "held up" in found:
            assert self.summary["commands_missed"] > 0
            pytest.skip(f"this machine held the client up: {found['held up']}")
        return found


def visit(protocol, *actions, faults=()):
    fci_clients.demand(protocol)
    with fci_clients.robot(protocol, *faults) as end:
        found = fci_clients.client(protocol, *actions)
        return Visit(protocol, found, end())


@pytest.fixture(scope="module", params=[5, 10])
def visited(request):
    """A client that did one thing after the other, without faults of the robot."""
    return visit(request.param, MODEL[request.param], *SHARED)


def oracle(q, dq, load=None, robot="panda"):
    """Gravity (7,), mass matrix (7, 7) and Coriolis torques (7,) of an arm by Pinocchio."""
    model, still = pin_model(documented(robot), load), np.zeros(7)
    data = model.createData()
    gravity = pin.rnea(model, data, q, still, still)
    columns = [pin.rnea(model, data, q, still, unit) - gravity for unit in np.eye(7)]
    return gravity, columns, pin.rnea(model, data, q, dq, still) - gravity


def test_a_robot_with_patience_waits_for_a_late_client(visited):
    visited.seen("torque")
    assert visited.summary["stalled_ms"] > 900 * fci_clients.LATE_ONCE_S


def skipped(seen):
    ids = seen["ids"]
    return ids[-1] - ids[0] + 1 - len(ids)


@pytest.mark.parametrize(("action", "count"), [("read", 1000), ("torque", 1000)])
def test_states_come_in_order_and_a_torque_loop_answers_each(visited, action, count):
    seen = visited.seen(action)
    assert len(seen["ids"]) == count and np.all(np.diff(seen["ids"]) > 0)
    assert visited.summary["states_sent"] >= count + skipped(seen)


@pytest.mark.parametrize("action", PROVOCATIONS)
def test_violation_is_named_and_recovered_from(visited, action):
    named_and_recovered(visited.seen(action), TOLD[action])


def named_and_recovered(seen, flag):
    assert f'motion aborted by reflex! ["{flag}"]' in seen["error"]
    assert "Reflex" in seen["mode"] and seen["flags"] == f'["{flag}"]'
    assert "not possible in the current mode" in seen["refused"]
    assert seen["again"] == 100 and "Idle" in seen["mode_after"]


def test_commands_and_violations_are_accounted_for(visited):
    """One violation for each provocation, in their order, but for motions that were held up."""
    for action in SHARED:
        visited.seen(action)
    summary = visited.summary
    repeats = sum(visited.found[action]["repeats"] for action in SHARED)
    told = summary["violations"]
    assert len(told) == len(PROVOCATIONS) + repeats
    for flag in (TOLD[action] for action in PROVOCATIONS):
        assert flag in told
    if not repeats:
        assert told == [TOLD[action] for action in PROVOCATIONS]
    # ticks of motions that went through: torques, four times after a recovery, to and fro
    assert summary["commands_received"] + summary["commands_missed"] >= 0.98 * (1000 + 400 + 3000)
    assert summary["clients"] == 1 + (visited.protocol == 5)  # the model library is one


seldom = pytest.mark.slow  # the same with the other robot's client


@pytest.mark.parametrize("protocol", [5, pytest.param(10, marks=seldom)])
def test_a_reflex_is_named_and_recovered_from(protocol):
    met = visit(protocol, "tripped", faults=("reflex=cartesian_reflex@0.5",))
    named_and_recovered(met.seen("tripped"), TOLD["tripped"])


@pytest.mark.parametrize("protocol", [10, pytest.param(5, marks=seldom)])
def test_user_stop_ends_a_motion_until_it_is_released(protocol):
    seen = visit(protocol, "user_stop", faults=("user_stop=1@0.5",)).seen("user_stop")
    assert "aborted: User Stop pressed" in seen["error"] and "Stopped" in seen["mode"]
    assert "not possible in the current mode" in seen["refused"]
    assert seen["again"] == 100


@pytest.mark.parametrize("protocol", [5, pytest.param(10, marks=seldom)])
def test_another_version_is_said(protocol):
    said = visit(protocol, "connect", faults=("version=7",)).found["connect"]["error"]
    assert "version" in said and "7" in said


def test_joint_positions_are_followed(visited):
    seen = visited.seen("joints")
    np.testing.assert_allclose(seen["moved"], [0.2, 0, 0, 0.2, 0, 0, 0], atol=2e-3)
    np.testing.assert_allclose(seen["back"], 0.0 * np.array(seen["moved"]), atol=5e-3)


def test_settings_are_taken_or_refused(visited):
    seen = visited.seen("settings")
    # how far a longer tool raises the hand depends on where motions before left the flange pointing
    assert abs(seen["upward"]) > 0.2, "the flange points sideways: the tool's length would not show"
    assert seen["raised"] == pytest.approx(0.1 * seen["upward"], abs=1e-3)
    np.testing.assert_allclose(seen["load"][:4], [0.5, 0.0, 0.01, 0.05], atol=1e-6)
    np.testing.assert_allclose(seen["load"][4:], 1e-3 * np.eye(3).ravel(), atol=1e-9)
    for key in ("bad_load", "bad_frame", "stiff"):
        assert "invalid argument" in seen[key]


def test_the_robot_s_model_is_the_arm(visited):
    seen = visited.found[MODEL[visited.protocol]]
    assert "failed" not in seen, seen
    if visited.protocol == 5:
        check_library(seen)
    else:
        gravity, columns, _ = oracle(np.array(seen["q"]), np.zeros(7), robot="fr3")
        np.testing.assert_allclose(seen["gravity"], gravity, atol=1e-3)
        np.testing.assert_allclose(np.reshape(seen["mass"], (7, 7)), columns, atol=1e-4)


def check_library(seen):
    """All that the Panda's model library computes, against Pinocchio."""
    mass, com, inertia = seen["load"]
    load = payload(mass, [*com[:2], com[2] + FLANGE_M], np.reshape(inertia, (3, 3)))
    q, dq = np.array(seen["q"]), np.array(seen["dq"])
    gravity, columns, coriolis = oracle(q, dq, load)
    np.testing.assert_allclose(seen["gravity"], gravity, atol=1e-9)
    np.testing.assert_allclose(seen["coriolis"], coriolis, atol=1e-9)
    np.testing.assert_allclose(np.reshape(seen["mass"], (7, 7)), columns, atol=1e-9)
    # poses and Jacobians of the nine frames by numerical differentiation of the poses
    model = pin_model(panda())
    data = model.createData()
    tools = [(k, 0.0, np.eye(4)) for k in range(1, 8)]
    tools += [(7, FLANGE_M, np.eye(4)), (7, FLANGE_M, np.array(seen["tool"]))]
    for i, (count, length, tool) in enumerate(tools):

        def at(q, count=count, length=length, tool=tool):
            placement = pin.SE3(np.eye(3), np.array([0.0, 0.0, length])).homogeneous @ tool
            pin.forwardKinematics(model, data, q)
            return data.oMi[count].homogeneous @ placement

        pose = at(q)
        np.testing.assert_allclose(seen["poses"][i], pose.ravel("F"), atol=1e-12)
        J = np.zeros((6, 7))
        for j in range(count):
            h = 1e-6 * np.eye(7)[j]
            change = (at(q + h) - at(q - h)) / 2e-6
            spin = change[:3, :3] @ pose[:3, :3].T
            J[:, j] = *change[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]
        np.testing.assert_allclose(seen["zero"][i], J.ravel("F"), atol=1e-8)
        inward = np.kron(np.eye(2), pose[:3, :3].T)
        np.testing.assert_allclose(seen["body"][i], (inward @ J).ravel("F"), atol=1e-8)
