"""What differs between two models is told joint by joint, and what no data can show is said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.cli.diff import difference_json, difference_matrix, difference_summary, effect_rows
from adapter.errors import ModelError
from adapter.model.locking import locked
from adapter.model.model_file import save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel, Tool
from adapter.model.spatial import exp_rotation, zxz_from_matrix
from adapter.runs.compare import Change, ModelDifference, compare, documentation_of

PANDA = documented("panda")


def bent(joint: int, turn: list[float], shift: list[float]) -> SelfModel:
    """The Panda with one joint frame (from 0) turned and shifted, in its parent's axes."""
    lam = PANDA.lam.copy()
    lam[joint, :3] = zxz_from_matrix(exp_rotation(turn) @ PANDA.joint_rotation()[joint])
    lam[joint, 3:] += shift
    return replace(PANDA, lam=lam)


def heavier(change: dict[tuple[int, int], float]) -> SelfModel:
    """The Panda with parameters (link, place), both from 0, changed."""
    theta = PANDA.theta.copy()
    for at, value in change.items():
        theta[at] += value
    return replace(PANDA, theta=theta)


def only(found: ModelDifference) -> Change:
    """The one change that there is."""
    (change,) = found.changes
    return change


def told(found: ModelDifference) -> dict[str, str]:
    """What is listed, by joint and kind, or by the effect's name."""
    of_joints = {
        f"{joint} {kind}": cell
        for joint, *cells in difference_matrix(found)
        for kind, cell in zip(("frame", "body"), cells, strict=True)
        if cell
    }
    return of_joints | {what: said for what, said, *_ in effect_rows(found)}


def test_a_model_is_the_same_as_itself() -> None:
    found = compare(PANDA, PANDA)
    assert not told(found)
    assert difference_summary(found) == ["panda and panda are the same"]
    assert found.hand_max_m == 0.0 and not found.torque_nm.any()


def test_a_frame_that_moved_moves_the_hand() -> None:
    found = compare(PANDA, bent(3, [0.0, 0.02, 0.0], [0.0, 0.0, 0.004]))
    moved = only(found)
    assert moved.what == "frame" and moved.joint == "panda_joint4" and moved.link == "panda_link4"
    assert moved.values["turn_rad"][1] == pytest.approx(0.02)
    assert moved.values["shift_m"][1] == pytest.approx(0.004)
    assert moved.shown == 1.0 and moved.z is None
    assert 0.004 < found.hand_rms_m < 0.02 * 0.7 + 0.004 and found.torque_nm[1] > 0.01
    assert moved.hand_m == found.hand_rms_m and moved.torque_nm == found.torque_nm.max()
    assert told(found)["panda_joint4 frame"].startswith("turned by 1.15°, moved by 4 mm\n(hand")


def test_what_no_motion_shows_is_said() -> None:
    """Joint 1 of an upright arm: its turn about gravity. Joint 2: its shift along axis 1."""
    for model, name in (
        (bent(0, [0.0, 0.0, 0.3], [0.0, 0.0, 0.05]), "panda_joint1"),
        (bent(1, [0.0, 0.0, 0.0], [0.0, 0.0, 0.01]), "panda_joint2"),
    ):
        found = compare(PANDA, model)
        moved = only(found)
        assert moved.joint == name and not moved.shown
        assert "data can show none of it" in told(found)[f"{name} frame"]
        assert found.torque_nm.max() < 1e-9
        assert found.hand_max_m > 5e-3  # and yet the hand is elsewhere


def test_masses_that_no_torque_shows_are_said() -> None:
    found = compare(PANDA, heavier({(0, 0): 1.0}))
    hidden = only(found)
    assert hidden.what == "body" and not hidden.shown and hidden.torque_nm < 1e-9
    assert not told(found)
    assert "the hand stays: panda_link1 body" in difference_summary(found)[-1]
    found = compare(PANDA, heavier({(6, 0): 0.5}))
    assert only(found).shown and found.torque_nm[1] > 1.0 and found.hand_max_m == 0.0
    assert told(found)["panda_joint7 body"].startswith("0.7355 -> 1.236 kg")


def test_what_does_most_stands_first() -> None:
    theta = heavier({(6, 0): 0.5, (3, 0): 1e-3}).theta
    model = replace(bent(5, [0.0, 0.0, 0.0], [0.0, 5e-4, 0.0]), theta=theta)
    found = compare(PANDA, model)
    order = [f"{change.joint} {change.what}" for change in found.changes]
    assert order == ["panda_joint7 body", "panda_joint6 frame", "panda_joint4 body"]
    assert told(found).keys() == set(order)
    assert found.changes[0].torque_joint == "panda_joint2"


def test_standard_deviations_count() -> None:
    """A body is judged by what torques show: mass put where they show it whole."""
    std = np.full((7, 10), 0.01)
    model = replace(heavier({(6, 1): 0.2}), theta_std=std)
    assert only(compare(replace(PANDA, theta_std=std), model)).z == pytest.approx(
        0.2 / np.hypot(0.01, 0.01), rel=1e-6
    )
    moved = replace(bent(3, [0.0, 0.0, 0.0], [0.0, 0.004, 0.0]), lam_std=np.full((7, 6), 1e-3))
    assert only(compare(PANDA, moved)).z == pytest.approx(4.0)


def test_noise_is_one_sentence() -> None:
    noise = replace(heavier({(6, 1): 0.02}), theta_std=np.full((7, 10), 0.01))
    found = compare(PANDA, noise)
    assert only(found).z == pytest.approx(2.0, rel=1e-6) and not told(found)
    assert difference_summary(found)[-1] == (
        "not listed: 1 by less than 4 standard deviations (body 1)"
    )


def test_effects_are_compared() -> None:
    rubs = {"effect": "coulomb_friction", "joints": [2, 3], "parameters": {"Fc": [0.4, 0.3]}}
    more = {**rubs, "parameters": {"Fc": [0.4, 0.5]}, "std": {"Fc": [0.01, 0.02]}}
    change = only(compare(replace(PANDA, effects=(rubs,)), replace(PANDA, effects=(more,))))
    assert (change.what, change.joint) == ("coulomb_friction", "panda_joint3")
    assert change.values == {"Fc": (0.3, 0.5)} and change.z == pytest.approx(10.0)
    assert change.torque_joint == "panda_joint3"
    assert change.torque_nm == pytest.approx(0.2, rel=0.05)
    gone = compare(replace(PANDA, effects=(rubs,)), PANDA)
    assert "panda_joint3: Fc 0.3 -> none N m" in told(gone)["coulomb_friction"].splitlines()
    json.dumps(difference_json(gone), allow_nan=False)


def test_gravity_tool_and_load_are_compared() -> None:
    """A load is told as the body that it makes heavier."""
    load = {"effect": "payload", "parameters": {"m": 0.5, "cx": 0.0, "cy": 0.0, "cz": 0.1}}
    tool = Tool(0.8, np.zeros(3), np.diag([1e-3, 1e-3, 1e-3]))
    wall = np.array([9.81, 0.0, 0.0])
    found = compare(PANDA, replace(PANDA, effects=(load,), tool=tool, gravity=wall))
    assert {change.what for change in found.changes} == {"body", "tool", "gravity"}
    said = told(found)
    assert said["gravity"] == "0 0 -9.81 -> 9.81 0 0 m/s²"
    assert said["tool"] == "mass_kg 0 -> 0.8 kg"
    assert said["panda_joint7 body"].startswith("0.7355 -> 1.236 kg")


def test_other_trees_are_refused() -> None:
    said = "different trees; joint names: panda_joint1, .*joint7 and.*--lock JOINT=VALUE takes one"
    with pytest.raises(ModelError, match=said):
        compare(PANDA, locked(PANDA, {"panda_joint4": 0.0}))
    with pytest.raises(ModelError, match="its base floats"):
        compare(PANDA.with_base(True), PANDA.with_base(True))
    with pytest.raises(ModelError, match="give a second model"):
        documentation_of(replace(PANDA, source=None, name="mine"))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], refused) -> None:
    path = str(save_model(heavier({(6, 0): 0.5}), tmp_path / "learned.json"))
    assert main(["diff", path, "--json", "-"]) == 0  # against its documentation
    said = capsys.readouterr()
    assert json.loads(said.out)["changes"][0]["values"]["mass_kg"] == pytest.approx(
        [0.7355, 1.2355], abs=1e-4
    )
    assert "the link behind it" in said.err and "0.7355 -> 1.236 kg" in said.err
    assert main(["diff", "panda", path, "--json", str(tmp_path / "diff.json")]) == 0
    assert json.loads((tmp_path / "diff.json").read_text())["hand_max_m"] == 0.0
    assert "thumb" in refused("diff", path, "panda", "--lock", "thumb=1")


def test_frames_and_bodies_are_a_matrix_in_the_order_of_the_joints() -> None:
    """What differs most does not come first: a row per joint, its frame beside its link."""
    moved = bent(5, [0.0, 0.03, 0.0], [0.0, 0.0, 0.002])
    both = replace(heavier({(2, 1): 0.2, (5, 1): 0.3}), lam=moved.lam)
    first, second = difference_matrix(compare(PANDA, both))
    assert (first[0], second[0]) == ("panda_joint3", "panda_joint6")
    assert first[1] == "" and "kg" in first[2] and "N m on" in first[2]
    assert second[1].startswith("turned by 1.72°") and "hand" in second[1] and "kg" in second[2]
    assert not effect_rows(compare(PANDA, both))


def test_an_effect_of_several_joints_is_one_row() -> None:
    entries = [
        {"effect": "coulomb_friction", "joints": [j], "parameters": {"Fc": 0.1 * j}} for j in (3, 5)
    ]
    (row,) = effect_rows(compare(PANDA, replace(PANDA, effects=tuple(entries))))
    assert row[0] == "coulomb_friction" and row[1].splitlines() == [
        "panda_joint3: Fc none -> 0.3 N m",
        "panda_joint5: Fc none -> 0.5 N m",
    ]
