"""A free path: what a motion may touch, found against a dense look with formulas of its own."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from adapter.control.designed import DesignedMotion, Designer
from adapter.control.excitation import RandomMotion
from adapter.control.free_path import ArmInCell, FreeMotion
from adapter.control.information import Information
from adapter.control.limits import MotionLimits
from adapter.control.settings import Box, Cell, Cylinder, ExcitationSettings, Hand, Plane, gentle
from adapter.control.shapes import bodies_of
from adapter.errors import ModelWarning, SettingsError
from adapter.model.robots import documented
from adapter.model.urdf import model_from_urdf
from adapter.runs.config import config_from, config_table
from sim.scenarios import build
from tests.helpers.robot_models import PANDA as PANDA_URDF

pytest.importorskip("coal")
PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
READY = build("nominal").truth.ready
SPAN_S = 8.0


def _poses(motion, every_s):
    for s in np.arange(0.0, SPAN_S, every_s):
        yield motion.path(s)[0].copy()


def _along(ends, count=25):
    return ends[0] + np.linspace(0.0, 1.0, count)[:, None] * (ends[1] - ends[0])


@pytest.mark.parametrize("seed", range(3))
def test_nothing_lies_between_two_looks(seed):
    """A dense look at box, wall and table finds what was found, to its own step."""
    centre, half, wall = np.array([0.5, 0.45, 0.75]), np.array([0.1, 0.05, 0.2]), 0.9
    things = Cell(
        margin=0.01,
        box=(Box("box", tuple(2.0 * half), tuple(centre)),),
        plane=(Plane("wall", (-1.0, 0.0, 0.0), -wall),),
        allowed=tuple(combinations((f"panda_link{k}" for k in range(8)), 2)),
    )
    arm = ArmInCell(PANDA, things)
    motion = RandomMotion(LIMITS, READY, ExcitationSettings(seed=seed))
    dense = np.inf
    for q in _poses(motion, 0.01):
        for capsule, (ends, radius) in zip(arm.bodies, arm.placed(q), strict=True):
            if capsule.link > 0:
                points = _along(ends)
                beside = np.linalg.norm(np.maximum(np.abs(points - centre) - half, 0.0), axis=1)
                gaps = beside, wall - points[:, 0], points[:, 2]
                dense = min(dense, *(gap.min() - radius for gap in gaps))
    assert arm.clearance(motion, SPAN_S).distance == pytest.approx(dense, abs=0.02)


CELLS = {
    "low shelf": Cell(box=(Box("shelf", (0.6, 1.0, 0.02), (0.6, 0.0, 0.95)),)),
    "pillar": Cell(cylinder=(Cylinder("pillar", 0.05, 1.5, (0.35, 0.35, 0.75)),)),
    "wall": Cell(plane=(Plane("wall", (0.0, -2.0, 0.0), -0.3),)),
    "reach": Cell(reach=0.98),
    "long hand": Cell(hand=Hand(0.5, 0.08)),
}


@pytest.mark.parametrize("cell", CELLS.values(), ids=list(CELLS))
def test_a_motion_that_would_touch_is_drawn_again(cell):
    """The first motion of these seeds would not keep the margin; the one that is drawn does."""
    arm, settings = ArmInCell(PANDA, cell), gentle(ExcitationSettings(seed=3))
    first = arm.clearance(RandomMotion(LIMITS, READY, settings), SPAN_S)
    assert first.distance < cell.margin
    draw = FreeMotion(arm, SPAN_S)
    motion = draw(LIMITS, READY, settings)
    assert draw.least.distance >= cell.margin
    assert min(arm.at(q).distance for q in _poses(motion, 0.05)) >= cell.margin - 0.005
    np.testing.assert_array_equal(draw(LIMITS, READY, settings).phase, motion.phase)


def test_an_arm_that_stands_too_near_or_has_no_room_is_not_moved():
    """The hand is at x = 0.31, z = 0.59; what it touches is named."""
    crate = Cell(box=(Box("crate", (0.2, 0.2, 0.2), (0.35, 0.0, 0.5)),))
    with pytest.raises(SettingsError, match=r"too near to start: -?0\.\d+ m between .* and crate"):
        FreeMotion(ArmInCell(PANDA, crate), SPAN_S)(LIMITS, READY, ExcitationSettings())


def test_only_the_joints_asked_for_move():
    settings = ExcitationSettings(move=("panda_joint2", "panda_joint7"))
    motion = RandomMotion(LIMITS, READY, settings)
    lower, upper = motion.bounds()[:2]
    np.testing.assert_array_equal(upper - lower > 0.0, [0, 1, 0, 0, 0, 0, 1])
    motion.advance(3.0)
    np.testing.assert_array_equal(motion.q[[0, 2, 3, 4, 5]], READY[[0, 2, 3, 4, 5]])
    with pytest.raises(SettingsError, match=r"no joint 'elbow' to move; have: panda_joint1"):
        RandomMotion(LIMITS, READY, replace(settings, move=("elbow",)))


def test_a_cell_is_read_from_toml_and_kept_in_a_recording():
    table = {
        "cell": {
            "margin": 0.04,
            "box": [{"name": "a", "size": [1, 1, 1], "xyz": [2, 0, 0]}],
            "plane": [{"name": "b", "normal": [1, 0, 0], "offset": -2}],
            "cylinder": [{"name": "c", "radius": 0.1, "length": 1, "xyz": [0, 2, 0]}],
            "allowed": [["panda_link5", "a"]],
        }
    }
    config = config_from(table)
    assert config.cell.box[0].size == (1.0, 1.0, 1.0) and config.cell.plane[0].offset == -2.0
    assert config_from(config_table(config)) == config
    for wrong, said in (
        ({"bax": []}, "no setting 'bax'; have: .*; did you mean box"),
        ({"box": [{"name": "a", "size": [1, 1], "xyz": [0, 0, 0]}]}, "'a': size needs 3 lengths"),
        ({"plane": [{"name": "a", "normal": [0, 0, 0], "offset": 0}]}, "must not be zero"),
        ({"margin": 0.0}, "margin must be at least"),
        ({"box": [{"name": "table", "size": [1, 1, 1], "xyz": [0, 0, 9]}]}, "name of its own"),
    ):
        with pytest.raises(SettingsError, match=said):
            config_from({"cell": wrong})
    with pytest.raises(SettingsError, match=r"no 'moon'; have: .*panda_link7.*table"):
        ArmInCell(PANDA, Cell(allowed=(("moon", "table"),)))


ARM = """<robot name="two"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
<inertia ixx="0.03" iyy="0.03" izz="0.0025" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="fore"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial>SHAPE</link>
<joint name="a" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="10"/></joint>
<joint name="b" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="10"/></joint></robot>"""
SHAPE = """<collision><origin xyz="0 0 0.15" rpy="0 0 0"/><geometry><box size="0.06 0.08 0.3"/>
</geometry></collision><collision><geometry><mesh filename="x.stl"/></geometry></collision>"""


def test_an_arm_of_ones_own_gets_its_shapes_from_its_file():
    bare = {c.link: c for c in bodies_of(model_from_urdf(ARM.replace("SHAPE", "")))}
    assert np.linalg.norm(bare[0].ends[1] - bare[0].ends[0]) == pytest.approx(0.4)
    assert bare[0].radius == pytest.approx(0.05)  # of a cylinder of 2 kg with 0.0025 kg m²
    assert np.linalg.norm(bare[1].ends[1]) == pytest.approx(0.2)  # twice to its centre
    model = model_from_urdf(ARM.replace("SHAPE", SHAPE))
    with pytest.warns(ModelWarning, match=r"link 'fore': its mesh is not used \(x.stl: the folder"):
        box, inertia = (body for body in bodies_of(model) if body.link == 1)
    assert box.radius == pytest.approx(0.05)  # half the diagonal of 0.06 by 0.08
    assert inertia.radius == pytest.approx(0.03)  # the mesh may be larger than the box
    with pytest.warns(ModelWarning, match="by its inertia"):
        straight = ArmInCell(model, Cell()).placed(np.zeros(2))
    high = max(ends[:, 2].max() for ends, _ in straight)
    assert high == pytest.approx(0.8)  # 0.1 + 0.4 + 0.3, whatever axes the joints turn about


def test_a_panda_with_a_hand_in_its_file_needs_room_for_it():
    hand = '<link name="hand"/><joint name="h" type="fixed"><parent link="panda_link8"/>'
    hand += '<child link="hand"/><origin xyz="0 0 0.1"/></joint></robot>'
    model = model_from_urdf(PANDA_URDF.read_text().replace("</robot>", hand))
    assert len(bodies_of(model)) == len(bodies_of(PANDA)) + 1


def test_what_comes_too_near_says_which_way_out():
    arm = ArmInCell(PANDA, Cell(box=(Box("box", (0.2, 0.1, 0.4), (0.5, 0.45, 0.75)),)))
    rng = np.random.default_rng(0)
    poses = rng.uniform(LIMITS.lower, LIMITS.upper, (12, 7))
    short, slope = arm.too_near(poses, 0.1)
    assert short > 0.0
    for _ in range(4):
        way = rng.normal(size=poses.shape)
        up, down = (arm.too_near(poses + s * 1e-4 * way, 0.1)[0] for s in (1, -1))
        assert (slope * way).sum() == pytest.approx((up - down) / 2e-4, rel=0.05, abs=0.02)
    assert arm.too_near(READY[None], 0.02) == (0.0, pytest.approx(0.0))


def test_a_designed_motion_keeps_clear_of_the_cell_too():
    box = Box("box", (0.2, 0.1, 0.4), (0.5, 0.45, 0.75))
    arm = ArmInCell(PANDA, Cell(box=(box,)))
    designer = Designer(Information(PANDA), steps=25).within(arm)
    motion = FreeMotion(arm, 12.0, designer)(LIMITS, READY, ExcitationSettings(seed=1))
    assert isinstance(motion, DesignedMotion)
    nearest = min(arm.at(q).distance for q in _poses(motion, 0.05))
    assert nearest >= arm.cell.margin - 1e-3
    width = np.subtract(*motion.bounds()[1::-1])
    assert width.max() > 0.5  # it was not merely shrunk to nothing
