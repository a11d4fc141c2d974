"""What each format keeps of an effect: the table of the docs, asked of the effects themselves.

    python -m tests.effects.test_formats

prints it.
"""

from __future__ import annotations

import ast
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import adapter
from adapter.cli import main
from adapter.cli.exit_codes import ExitCode
from adapter.cli.files_options import FORMATS
from adapter.effects.c_text import c_text
from adapter.effects.catalogue import KNOWN
from adapter.effects.robots import additions, kept_lines, robot_text
from adapter.errors import ModelError
from adapter.model.filled import PLACES
from adapter.model.inertia import move_theta, tensor_from_six, theta_from_body
from adapter.model.model_file import save_model
from adapter.model.self_model import LIMITS, SelfModel
from adapter.model.spatial import matrix_from_quaternion, matrix_from_rpy
from adapter.model.urdf_text import SIX, Additions, as_file
from tests.helpers.pages import PAGES
from tests.helpers.robot_models import machine_urdf, read_quietly, urdf_text
from tests.model.test_onto import learned
from tests.simulate.test_rollouts import BALL, CASES, SENSED, model_with


def table() -> str:
    """A row for each effect, a column for each format."""
    lines = ["| effect | URDF | MJCF | SDF | USD, Isaac Lab | C |", "|---|---|---|---|---|---|"]
    body = {**BALL, "inertia": [2e-3, 0.0, 0.0, 2e-3, 0.0, 2e-3]}  # kg m2, of 1 kg
    ball = replace(CASES[0], name="payload", joints=(), parameters=body)
    for name, effect in {x.name: x for x in (*CASES, *SENSED, ball)}.items():
        model, title = model_with(replace(effect, interval_s=None)), KNOWN[name].title
        kept = [additions(model, places).kept for places in list(PLACES.values())[:4]]
        heads = (kept_lines(own[:1])[0] for own in (*kept, c_text(model).kept))
        lines.append(f"| {' | '.join((title, *(x.partition(': ')[2] for x in heads)))} |")
    return "\n".join(lines)


def test_the_table_of_formats_is_what_effects_do() -> None:
    assert table() in PAGES["docs/simulate-what-was-learned.md"], (
        "python -m tests.effects.test_formats"
    )


AT_JOINTS = (
    {"effect": "viscous_friction", "joints": [1, 3], "parameters": {"Fv": [0.1, 0.2]}},
    {"effect": "coulomb_friction", "joints": [1], "parameters": {"Fc": 0.3}},
    {"effect": "stribeck_friction", "joints": [2], "parameters": {"Fc": 0.4, "Fs": 0.7, "vs": 0.1}},
    {"effect": "motor_inertia", "joints": [1, 3], "parameters": {"B": [0.15, 0.2]}},
    {"effect": "joint_spring", "joints": [4], "parameters": {"k": 1.5, "q0": -0.4}},
)
NUMBERS = {  # what SDF, PhysX and Isaac Lab call those of a joint, and those of joints 1 to 4
    "armature": (None, "armature", "armature", [0.15, 0.0, 0.2, 0.0]),
    "static": (None, "staticFrictionEffort", "friction", [0.3, 0.7, 0.0, 0.0]),
    "dynamic": ("friction", "dynamicFrictionEffort", "dynamic_friction", [0.3, 0.4, 0.0, 0.0]),
    "viscous": ("damping", "viscousFrictionCoefficient", "viscous_friction", [0.1, 0.0, 0.2, 0.0]),
    "spring": ("spring_stiffness", None, None, [0.0, 0.0, 0.0, 1.5]),
    "rest": ("spring_reference", None, None, [0.0, 0.0, 0.0, -0.4]),
}


@pytest.fixture(params=[urdf_text("panda"), machine_urdf("scara")], ids=["panda", "scara"])
def arm(request: pytest.FixtureRequest) -> SelfModel:
    return replace(learned(read_quietly(request.param)), name="an arm", effects=AT_JOINTS)


def apart(read: dict[str, list[Any]], model: SelfModel) -> float:
    """By how much what was read of a file differs from the model, of its size at the most.

    Of each link θ, and of each joint its child's place in its parent, axis, limits: all by name.
    """
    robot, worst = as_file(model, Additions(model.tree.n, False, ())), [0.0]
    true = {name: [x[:1], x[1:4], x[4:]] for name, x in robot.links.items() if x[0]}
    for name in model.tree.joint_names:
        joint = robot.joints[name]
        true[name] = [joint.rotation, joint.position, joint.axis, *joint.limits]
    for name, values in true.items():
        for found, own in zip(read[name], values, strict=True):
            worst.append(np.abs(found - own).max() / max(np.abs(own).max(), 1e-2))
    return float(max(worst))


def test_sdf_reads_back(arm: SelfModel) -> None:
    written = robot_text("sdf", arm)
    root, read, at = ET.fromstring(written.text), dict[str, list[Any]](), {}

    def numbers(element: ET.Element, path: str) -> np.ndarray:
        return np.array(element.findtext(path, "nan").split(), float)

    for link in root.iter("link"):
        name, pose = link.get("name", ""), numbers(link, "pose")
        at[name] = matrix_from_rpy(pose[3:]), pose[:3]
        tensor = tensor_from_six([numbers(link, f"inertial/inertia/{x}")[0] for x in SIX])
        com, mass = numbers(link, "inertial/pose")[:3], numbers(link, "inertial/mass")[0]
        theta = theta_from_body(mass, com, tensor)
        read[name] = [theta[:1], theta[1:4], theta[4:]]
    for joint in root.iter("joint"):
        if (name := joint.get("name", "")) in arm.tree.joint_names:
            (r0, p0), (r1, p1) = (at[joint.findtext(x, "")] for x in ("parent", "child"))
            read[name] = [r0.T @ r1, r0.T @ (p1 - p0), numbers(joint, "axis/xyz")]
            read[name] += [numbers(joint, f"axis/limit/{x}") for x in LIMITS]
            for key, _, _, own in NUMBERS.values():
                true = dict(zip(arm.tree.joint_names, own, strict=False)).get(name, 0.0)
                assert not key or numbers(joint, f"axis/dynamics/{key}") == pytest.approx(true)
    assert apart(read, arm) < 1e-12 and written.left_out == ("motor_inertia", "stribeck_friction")


def read_usd(path: Path, arm: SelfModel) -> dict[str, list[Any]]:
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(path))
    prims, read = {x.GetName(): x for x in stage.Traverse()}, dict[str, list[Any]]()

    def value(name: str, key: str) -> np.ndarray:
        found = prims[name].GetAttribute(key).Get()
        found = (found.GetReal(), *found.GetImaginary()) if hasattr(found, "GetReal") else found
        return np.array(0.0 if found is None else found, dtype=float)

    for name in prims:
        if value(name, "physics:mass"):
            turn = matrix_from_quaternion(value(name, "physics:principalAxes"))
            own = (
                value(name, "physics:mass"),
                np.zeros(3),
                np.diag(value(name, "physics:diagonalInertia")),
            )
            theta = move_theta(theta_from_body(*own), turn, value(name, "physics:centerOfMass"))
            read[name] = [theta[:1], theta[1:4], theta[4:]]
    for k, name in enumerate(arm.tree.joint_names):
        slides = arm.tree.slides[k]
        unit, kind = (1.0, "linear") if slides else (np.pi / 180.0, "angular")
        turns = [matrix_from_quaternion(value(name, f"physics:localRot{x}")) for x in (0, 1)]
        read[name] = [turns[0] @ turns[1].T, value(name, "physics:localPos0"), turns[1][:, 2]]
        read[name] += [unit * value(name, f"physics:{x}Limit") for x in ("lower", "upper")]
        read[name] += [unit * value(name, f"physxJointAxis:{kind}:maxJointVelocity")]
        read[name] += [value(name, f"drive:{kind}:physics:maxForce")]
        for which, (_, key, _, own) in NUMBERS.items():
            found = value(name, f"physxJointAxis:{kind}:{key}") / (
                unit if which == "viscous" else 1
            )
            assert found == pytest.approx(own[k] if key and k < 4 else 0.0, rel=2.0**-23)
    return read


def test_usd_and_a_layer_over_an_asset_read_back_in_their_precision(
    arm: SelfModel, tmp_path: Path
) -> None:
    assert apart(read_usd(adapter.export(arm, tmp_path / "arm.usda"), arm), arm) < 2.0**-23
    documented = read_quietly(urdf_text("panda") if arm.tree.n == 7 else machine_urdf("scara"))
    asset = adapter.export(replace(documented, name="an arm"), tmp_path / "asset.usda")
    whole, path = asset.read_bytes(), save_model(arm, tmp_path / "m.json")
    assert main(["export", str(path), "--onto", str(asset)]) == 0 and asset.read_bytes() == whole
    layer = tmp_path / "asset.learned.usda"
    assert apart(read_usd(layer, arm), arm) < 2.0**-23
    said = layer.read_text()
    assert "joint spring: no" in said and "Limit" not in said and "xformOp" not in said
    for was, now, why in (
        (b"metersPerUnit = 1", b"metersPerUnit = 0.01", "its units are 0.01 m"),
        (b"Pos1 = (0,", b"Pos1 = (1,", "does not pass through its link"),
        (whole, b"no USD", "cannot be read as USD"),
    ):
        (other := tmp_path / f"{why[:4]}.usda").write_bytes(whole.replace(was, now))
        with pytest.raises(ModelError, match=rf"{other.name}: .*{why}"):
            robot_text("usd", arm, other)


def test_isaac_lab_reads_the_models_numbers(arm: SelfModel) -> None:
    written = robot_text("isaac", arm)
    compile(written.text, "arm.py", "exec")
    (call,) = (x for x in ast.walk(ast.parse(written.text)) if isinstance(x, ast.Call))
    fields = {x.arg: ast.literal_eval(x.value) for x in call.keywords}
    assert fields.pop("joint_names_expr") == list(arm.tree.joint_names)
    for _, _, key, own in NUMBERS.values():
        assert not key or list(fields.pop(key).values()) == [*own, *[0.0] * (arm.tree.n - 4)]
    for key in ("effort", "velocity"):
        limits = fields.pop(f"{key}_limit_sim").values()
        np.testing.assert_array_equal(list(limits), getattr(arm.limits, key))
    assert fields == {"stiffness": None, "damping": None}
    silent = robot_text("isaac", replace(arm, effects=())).text
    assert "armature" not in silent and "friction=" not in silent  # the USD's stay


def test_the_answer_is_a_line_for_each_file_and_one_of_what_it_drops(
    arm: SelfModel, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    path = save_model(arm, tmp_path / "m.json")
    files = [tmp_path / f"arm{ends}" for ends, _ in FORMATS.values()]
    options = [
        x for kind, file in zip(FORMATS, files, strict=True) for x in (f"--{kind}", str(file))
    ]
    assert main(["export", str(path), "--alone", *options]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [x.partition(":")[0] for x in said if not x.startswith(" ")] == [str(x) for x in files]
    dropped = [x for x in said if x.startswith("  ")]
    assert "  drops joint spring, reflected motor inertia; holds in part Stribeck" in dropped[0]
    assert len(dropped) == 5 and all(len(x) < 200 for x in said)  # C has all
    assert all("Stribeck friction: " in x.read_text() for x in files)
    for name in {"pxr", *(x for x in sys.modules if x.startswith("pxr."))}:
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["export", str(path), "--onto", str(files[3])]) == ExitCode.NO_MEANS
    assert "usd-core is not installed: pip install 'panda-adapter[usd]'" in capsys.readouterr().err


if __name__ == "__main__":
    print(table())
