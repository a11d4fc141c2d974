"""Meshes of a cell and of a URDF: a box as triangles against coal's own box, and files that lie."""

from __future__ import annotations

import itertools
import math
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from adapter.control import shapes
from adapter.control.free_path import ArmInCell
from adapter.control.limits import MotionLimits
from adapter.control.settings import Box, Cell, Mesh
from adapter.control.shapes import bodies_of, file_of, read_mesh
from adapter.errors import ModelWarning, SettingsError
from adapter.model.robots import documented
from adapter.model.urdf import read_urdf
from adapter.runs.config import config_from, config_table, read_config
from tests.control.test_free_path import ARM

pytest.importorskip("coal")
PANDA = documented("panda")
SIZE, XYZ, RPY = (0.2, 0.1, 0.4), (0.5, 0.45, 0.75), (0.3, -0.2, 0.9)
CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
# Two triangles on each side; corner number 4 x + 2 y + z.
SIDES = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
TRIANGLES = [t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))]


def stl(size):
    out = b"a box".ljust(80) + struct.pack("<I", len(TRIANGLES))
    for rows in TRIANGLES:
        out += struct.pack("<12fH", 0, 0, 0, *(CORNERS[list(rows)] * size).ravel(), 0)
    return out


def text_stl(size):
    lines = ["solid box"]
    for rows in TRIANGLES:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x} {y} {z}" for x, y, z in CORNERS[list(rows)] * size]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid box", ""]).encode()


def obj(size):
    """Sides of four corners, half of them counted from the end."""
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS * size]
    for k, side in enumerate(SIDES):
        lines.append("f " + " ".join(f"{c - 8 if k % 2 else c + 1}/1/1" for c in side))
    return "\n".join([*lines, ""]).encode()


def poses(count):
    limits = MotionLimits.of(PANDA)
    return np.random.default_rng(5).uniform(limits.lower, limits.upper, (count, 7))


@pytest.mark.parametrize(
    ("name", "content", "scale"),
    [
        ("box.stl", stl(SIZE), 1.0),
        ("box.STL", text_stl(SIZE), 1.0),
        ("box.obj", obj(SIZE), 1.0),
        ("mm.stl", stl(1e3 * np.array(SIZE)), 1e-3),
    ],
)
def test_a_box_of_triangles_is_as_far_as_a_box(tmp_path: Path, name, content, scale):
    (tmp_path / name).write_bytes(content)
    mesh = Mesh("box", str(tmp_path / name), XYZ, RPY, scale)
    other = Box("box", SIZE, XYZ, RPY)
    one = ArmInCell(PANDA, Cell(table=False, mesh=(mesh,)))
    two = ArmInCell(PANDA, Cell(table=False, box=(other,)))
    compared = 0
    for q in poses(40):
        for arm in (one, two):
            arm.at(q)
        for a, b in zip(one._pairs, two._pairs, strict=True):
            assert a.names == b.names
            if "box" in a.names and (expected := two._distance(b)) > 1e-3:
                assert one._distance(a) == pytest.approx(expected, abs=1e-5)
                compared += 1
    assert compared > 200


MESH = """<collision><origin xyz="0 0 0.15"/><geometry><mesh filename="NAME" scale="0.1 0.1 0.3"/>
</geometry></collision>"""


def arm_in(folder: Path, name: str):
    """A package as ROS lays it out: urdf/ and meshes/ under a folder of its name."""
    package = folder / "two_description"
    for part in ("urdf", "meshes"):
        (package / part).mkdir(parents=True, exist_ok=True)
    (package / "meshes" / "fore.stl").write_bytes(stl((1.0, 1.0, 1.0)))
    (package / "urdf" / "two.urdf").write_text(ARM.replace("SHAPE", MESH.replace("NAME", name)))
    return read_urdf(package / "urdf" / "two.urdf")


@pytest.mark.parametrize(
    "name", ["package://two_description/meshes/fore.stl", "../meshes/fore.stl"]
)
def test_a_links_mesh_is_its_convex_hull(tmp_path: Path, name):
    """The upper end of a box of 0.1 x 0.1 x 0.3 m on the upright arm, and turned by 0.6 rad."""
    model = arm_in(tmp_path, name)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ModelWarning)
        (hull,) = (body for body in bodies_of(model) if body.link == 1)
    assert hull.triangles is not None and len(hull.ends) == 8
    shelf = Box("shelf", (2.0, 2.0, 0.1), (0.0, 0.0, 1.15))  # its underside is 1.1 m high
    cell = Cell(table=False, box=(shelf,), allowed=(("upper", "shelf"),))
    arm = ArmInCell(model, cell)
    assert arm.at(np.zeros(2)).distance == pytest.approx(1.1 - 0.8, abs=1e-6)
    high = 0.5 + 0.3 * math.cos(0.6) + 0.05 * math.sin(0.6)
    assert arm.at(np.array([0.0, 0.6])).distance == pytest.approx(1.1 - high, abs=1e-6)
    assert max(ends[:, 2].max() for ends, _ in arm.placed(np.array([0.0, 0.6]))) == pytest.approx(
        high
    )


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("package://two_description/meshes/none.stl", "no folder 'two_description' with that file"),
        ("package://two_description/../../secret.stl", "lies outside of"),
        ("../../../secret.stl", "lies outside of"),
        ("../meshes/none.stl", "no such file beside the URDF"),
        ("../meshes", "no such file beside the URDF"),
        ("../meshes/fore.dae", "meshes are read from .stl, .obj; convert it"),
    ],
)
def test_a_mesh_that_is_not_to_be_had_is_said_and_the_inertias_capsule_used(tmp_path, name, said):
    (tmp_path / "secret.stl").write_bytes(stl((1.0, 1.0, 1.0)))
    (tmp_path.parent / "secret.stl").write_bytes(stl((1.0, 1.0, 1.0)))
    model = arm_in(tmp_path, name)
    (tmp_path / "two_description" / "meshes" / "fore.dae").write_text("<COLLADA/>")
    with pytest.warns(ModelWarning) as caught:
        (body,) = (body for body in bodies_of(model) if body.link == 1)
    assert body.triangles is None
    assert len(caught) == 1 and said in str(caught[0].message)
    assert "link 'fore'" in str(caught[0].message)


def test_a_package_is_found_where_ros_says(tmp_path: Path, monkeypatch):
    mesh = tmp_path / "share" / "arm" / "meshes" / "a.stl"
    mesh.parent.mkdir(parents=True)
    mesh.write_bytes(stl(SIZE))
    (tmp_path / "urdf").mkdir()
    for listed in ("share", "share/arm"):
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{tmp_path / listed}")
        assert file_of("package://arm/meshes/a.stl", str(tmp_path / "urdf")) == mesh.resolve()


def _without_end(content):
    return content[: len(content) // 2]


def _with_nan(content):
    return content[:96] + struct.pack("<f", math.nan) + content[100:]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cut.stl", _without_end(stl(SIZE)), "says 12 triangles, which take 600 bytes"),
        ("cut.STL", _without_end(text_stl(SIZE)), "ends before its endsolid"),
        ("none.stl", b"", "it was cut off, or is no STL"),
        ("many.stl", b"x" * 80 + b"\xff" * 4 + b"y" * 60, "says 4294967295 triangles"),
        ("empty.stl", b"x" * 80 + bytes(4), "has no triangles"),
        ("nan.stl", _with_nan(stl(SIZE)), "a corner is not a finite number"),
        ("mm.stl", stl(1e3 * np.array(SIZE)), "a scale of 0.001 makes metres of millimetres"),
        ("word.stl", text_stl(SIZE).replace(b"0.05", b"zero"), "it has 3 numbers"),
        ("few.obj", obj(SIZE) + b"f 1 2 9\n", "a corner that the file does not have"),
        ("far.obj", obj(SIZE) + b"f 1 2 " + b"9" * 5000, "a corner that the file does not have"),
        ("word.obj", obj(SIZE) + b"f 1 2 x\n", "which is no number"),
        ("inf.obj", obj(SIZE) + b"v 1 2 1e999\n", "not a finite number"),
        ("a.ply", b"ply", "meshes are read from .stl, .obj"),
    ],
)
def test_a_file_that_lies_is_refused_in_a_sentence(tmp_path: Path, name, content, said):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(SettingsError) as refused:
        ArmInCell(PANDA, Cell(mesh=(Mesh("thing", str(path)),)))
    assert said in str(refused.value) and str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_too_large_is_refused_before_it_takes_memory(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(shapes, "MOST_TRIANGLES", 11)
    for name, content in (("a.stl", stl(SIZE)), ("b.stl", text_stl(SIZE)), ("c.obj", obj(SIZE))):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match="at most 11 are read, simplify it"):
            read_mesh(tmp_path / name)
    with (tmp_path / "d.stl").open("wb") as file:
        file.truncate(2**40)  # a hole: takes no room on the disk
    with pytest.raises(ValueError, match=r"d.stl: more than 32 MiB"):
        read_mesh(tmp_path / "d.stl")
    with pytest.raises(ValueError, match=r"/dev/zero: no such file"):
        read_mesh("/dev/zero")


def test_a_mesh_is_found_beside_the_settings_that_name_it(tmp_path: Path):
    (tmp_path / "box.stl").write_bytes(stl(SIZE))
    (tmp_path / "cell.toml").write_text(
        '[[cell.mesh]]\nname = "frame"\nfile = "box.stl"\nxyz = [0.5, 0.5, 0.5]\n'
    )
    config = read_config(tmp_path / "cell.toml")
    assert config.cell.mesh[0].file == str(tmp_path / "box.stl")
    assert config_from(config_table(config)) == config
    assert ("panda_link5", "frame") in [pair.names for pair in ArmInCell(PANDA, config.cell)._pairs]
    for wrong, said in (
        ({"name": "a", "file": "a.stl", "scale": 0.0}, "'a': scale must be above zero"),
        ({"name": "a", "file": "a.stl", "xyz": [1, 2]}, "'a': xyz and rpy need 3 numbers"),
        ({"name": "table", "file": "a.stl"}, "needs a name of its own"),
    ):
        with pytest.raises(SettingsError, match=said):
            config_from({"cell": {"mesh": [wrong]}})
