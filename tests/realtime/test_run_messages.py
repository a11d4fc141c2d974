"""What is told of a run beside its samples, against Pinocchio and against what a viewer needs."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from adapter.model.robots import documented
from adapter.model.spatial import matrix_from_quaternion, matrix_from_zxz, zxz_from_matrix
from adapter.model.urdf import model_from_urdf
from adapter.realtime.run_messages import RunMessages, ShownArm, nearest_frames
from adapter.realtime.snapshot import ExternalTorque
from drivers.files.estimates import EstimateNames
from drivers.files.messages import decode
from drivers.files.ros_types import TF
from tests.helpers.live_learners import nothing_known

URDF = """<robot name="bent"><link name="foot"/><link name="a"><inertial><mass value="1"/>
<origin xyz="0 0 0.1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<link name="b"><inertial><mass value="1"/><origin xyz="0 0 0.1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link><link name="tip"/>
<joint name="first" type="revolute"><parent link="foot"/><child link="a"/>
<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.2 0.5"/><axis xyz="0 -1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="second" type="revolute"><parent link="a"/><child link="b"/>
<origin xyz="0 0.1 0.4" rpy="1 0 0.2"/><axis xyz="0.6 0 0.8"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
<joint name="fixed" type="fixed"><parent link="b"/><child link="tip"/>
<origin xyz="0 0.05 0.1" rpy="0.1 0.2 0.3"/></joint></robot>"""


def placed(messages) -> dict[str, pin.SE3]:
    """Where each frame stands in the world, by the transforms of a viewer's tree."""
    found = {}
    for message in messages:
        for told in decode(TF, message.fields)["transforms"]:
            shift, turn = told["transform"]["translation"], told["transform"]["rotation"]
            R = matrix_from_quaternion(np.array([turn["w"], turn["x"], turn["y"], turn["z"]]))
            step = pin.SE3(R, np.array([shift[axis] for axis in "xyz"]))
            found[told["child_frame_id"]] = (told["header"]["frame_id"], step)

    def world(name: str) -> pin.SE3 | None:
        if name == "world":
            return pin.SE3.Identity()
        parent, step = found.get(name, (None, None))
        above = None if parent is None else world(parent)
        return None if above is None else above * step

    whole = {name: world(name) for name in found}
    return {name: place for name, place in whole.items() if place is not None}


def by_pinocchio(text: str, joints: tuple[str, ...], q: np.ndarray) -> dict[str, pin.SE3]:
    """Where every link of a URDF stands."""
    oracle = pin.buildModelFromXML(text)
    data, angles = oracle.createData(), pin.neutral(oracle)
    for name, value in zip(joints, q, strict=True):
        angles[oracle.joints[oracle.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(oracle, data, angles)
    return {frame.name: data.oMf[k] for k, frame in enumerate(oracle.frames)}


@pytest.mark.parametrize("text", [URDF, documented("panda").source.text], ids=["bent", "panda"])
def test_frames_are_those_of_the_urdf(text):
    model = model_from_urdf(text, "a.urdf")
    names = EstimateNames(model.tree.joint_names, model.tree.body_names, ())
    told = RunMessages(names, ShownArm.of(model))
    first = told.first(1)
    assert [m.topic for m in first] == ["/tf_static", "/robot_description"]
    assert all(m.latched for m in first) and first[1].fields["data"] == text
    q = np.linspace(-0.7, 0.9, model.tree.n)
    expected = by_pinocchio(text, model.tree.joint_names, q)
    before = placed([first[0], *told.frames(1, q)])
    learned = {name for name in before if name.startswith("learned/")}
    assert learned <= {f"learned/{model.tree.base_name}"}  # nothing is learned yet
    known = nothing_known(model.tree.n, model.tree.bodies, 0)
    told.estimate(replace(known, lam=model.lam, version=1))
    after = placed([first[0], *told.frames(1, q)])
    for prefix in ("documented", "learned"):
        for link in [*model.tree.link_names, *(f.name for f in model.frames)]:
            assert after[f"{prefix}/{link}"].isApprox(expected[link], 1e-9), (prefix, link)


def test_what_no_motion_shows_is_shown_as_documented():
    """A learned λ whose first frame stands anyhow is drawn onto the documented arm."""
    model = documented("panda")
    turn = matrix_from_zxz(np.array([0.7, 0.0, 0.0]))
    R, p = matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:].copy()
    R[0] = turn @ R[0]
    p[0] += [0.3, -0.2, 0.5]
    p[1] += [0.0, 0.0, 0.11]  # along the first joint's axis
    off = np.zeros((7, 6))
    off[3], p[3] = [0.0, 0.02, 0.0, 0.01, 0.0, -0.03], p[3] + [0.01, 0.0, -0.03]
    R[3] = matrix_from_zxz(np.array([np.pi / 2, 0.02, -np.pi / 2])) @ R[3]  # about the parent's y
    lam = np.concatenate([zxz_from_matrix(R), p], axis=1)
    arm = ShownArm.of(model)
    found = nearest_frames(arm.freedom, lam, model.lam)
    told = RunMessages(EstimateNames(model.tree.joint_names, model.tree.body_names, ()), arm)
    (message,) = told.estimate(replace(nothing_known(7, 7, 0), lam=lam, version=1))
    values = [[*joint["off"].values()] for joint in message.fields["joints"]]
    np.testing.assert_allclose(values, off, atol=1e-9)
    known = np.arange(7) != 3
    assert np.allclose(found[0][known], matrix_from_zxz(model.lam[known, :3]), atol=1e-9)
    assert np.allclose(found[1][known], model.lam[known, 3:], atol=1e-9)


def test_a_wrench_is_told_in_the_last_links_axes():
    model = documented("panda")
    told = RunMessages(EstimateNames(model.tree.joint_names, (), ()), ShownArm.of(model))
    q = np.array([0.3, -0.4, 0.2, -1.5, 0.1, 1.2, 0.5])
    wrench = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    nan = np.full(7, np.nan)
    push = ExternalTorque(nan, nan, wrench, wrench, None, False, 5, version=1)
    (message,) = told.push(push, q)
    assert not told.push(push, q)  # said once
    names = model.tree.joint_names
    R = by_pinocchio(model.source.text, names, q)["panda_link7"].rotation
    parts = message.fields["wrench"]
    assert message.fields["header"]["frame_id"] == "documented/panda_link7"
    assert np.allclose([*parts["force"].values()], R.T @ wrench[:3])
    assert np.allclose([*parts["torque"].values()], R.T @ wrench[3:])


def test_findings_are_told_when_they_change():
    told = RunMessages(EstimateNames(("a",), (), ()), None)
    finding = {"what": "payload", "joints": [2, 3], "since_s": 1.5, "reported_s": 2.0}
    finding |= {"over_s": None, "score": 7.25, "size": {"m": 0.5}, "line": "payload since 1.5 s"}
    (message,) = told.news(9, {"findings": [finding], "load": None})
    (status,) = message.fields["status"]
    assert (status["level"], status["message"]) == (1, "payload since 1.5 s")
    assert {"key": "joints", "value": "2, 3"} in status["values"]
    assert not told.news(9, {"findings": [finding]})
    over = {"findings": [{**finding, "over_s": 4.0}], "load": {"m": 0.5, "m_std": 0.01}}
    findings, load = told.news(10, over)
    assert findings.fields["status"][0]["level"] == 0
    assert load.fields["mass"] == 0.5 and np.isnan(load.fields["com"]["x"])
