"""What differs between two models is told joint by joint, and what no data can show is said."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.errors import ModelError
from adapter.model.locking import locked
from adapter.model.model_file import save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel
from adapter.model.spatial import exp_rotation, zxz_from_matrix
from adapter.report.difference_words import difference_json, difference_lines
from adapter.runs.compare import compare, documentation_of

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


def test_a_model_is_the_same_as_itself() -> None:
    found = compare(PANDA, PANDA)
    assert difference_lines(found) == ["panda and panda are the same"]
    assert found.hand_max_m == 0.0 and not any(joint.torque_rms_nm for joint in found.joints)


def test_a_frame_that_moved_moves_the_hand() -> None:
    found = compare(PANDA, bent(3, [0.0, 0.02, 0.0], [0.0, 0.0, 0.004]))
    moved = [joint for joint in found.joints if joint.frame_moved]
    assert [joint.joint for joint in moved] == ["panda_joint4"]
    assert moved[0].turn_rad == pytest.approx(0.02) and moved[0].shift_m == pytest.approx(0.004)
    assert moved[0].frame_shown and moved[0].frame_z is None
    assert 0.004 < found.hand_rms_m < 0.02 * 0.7 + 0.004 and found.joints[1].torque_rms_nm > 0.01
    line = difference_lines(found)[0]
    assert line == "panda_joint4: frame turned by 1.15° and moved by 4 mm"


def test_what_no_motion_shows_is_said() -> None:
    """Joint 1 of an upright arm: its turn about gravity. Joint 2: its shift along axis 1."""
    for model, name in (
        (bent(0, [0.0, 0.0, 0.3], [0.0, 0.0, 0.05]), "panda_joint1"),
        (bent(1, [0.0, 0.0, 0.0], [0.0, 0.0, 0.01]), "panda_joint2"),
    ):
        found = compare(PANDA, model)
        (moved,) = [joint for joint in found.joints if joint.frame_moved]
        assert moved.joint == name and not moved.frame_shown
        assert "no data can show it" in difference_lines(found)[0]
        assert max(joint.torque_rms_nm for joint in found.joints) < 1e-9
        assert found.hand_max_m > 5e-3  # and yet the hand is elsewhere


def test_masses_that_no_torque_shows_are_said() -> None:
    hidden = compare(PANDA, heavier({(0, 0): 1.0})).joints[0]
    assert hidden.body_changed and not hidden.body_shown and hidden.torque_rms_nm < 1e-9
    shown = compare(PANDA, heavier({(6, 0): 0.5}))
    assert shown.joints[6].body_shown and shown.joints[6].body_parameter == "m"
    assert shown.joints[1].torque_rms_nm > 1.0 and shown.hand_max_m == 0.0
    assert "panda_link7 0.7355 -> 1.236 kg" in difference_lines(shown)[0]


def test_standard_deviations_count() -> None:
    std = np.full((7, 10), 0.1)
    model = replace(heavier({(6, 0): 0.5}), theta_std=std, lam_std=np.full((7, 6), 1e-3))
    found = compare(replace(PANDA, theta_std=std), model).joints[6]
    assert found.body_z == pytest.approx(0.5 / np.hypot(0.1, 0.1))
    moved = replace(bent(3, [0.0, 0.0, 0.0], [0.0, 0.004, 0.0]), lam_std=np.full((7, 6), 1e-3))
    assert compare(PANDA, moved).joints[3].frame_z == pytest.approx(4.0)


def test_effects_are_compared() -> None:
    rubs = {"effect": "coulomb_friction", "joints": [2, 3], "parameters": {"Fc": [0.4, 0.3]}}
    more = {**rubs, "parameters": {"Fc": [0.4, 0.5]}, "std": {"Fc": [0.01, 0.02]}}
    found = compare(replace(PANDA, effects=(rubs,)), replace(PANDA, effects=(more,)))
    assert not found.joints[1].effects
    assert found.joints[2].effects["coulomb_friction.Fc"] == (0.3, 0.5, pytest.approx(10.0))
    assert found.joints[2].torque_rms_nm == pytest.approx(0.2, rel=0.05)
    gone = compare(replace(PANDA, effects=(rubs,)), PANDA)
    assert "coulomb_friction.Fc 0.3 -> none" in difference_lines(gone)[1]
    json.dumps(difference_json(gone), allow_nan=False)


def test_other_trees_are_refused() -> None:
    with pytest.raises(
        ModelError, match=r"different trees; joint names: panda_joint1, .*joint7 and"
    ):
        compare(PANDA, locked(PANDA, {"panda_joint4": 0.0}))
    with pytest.raises(ModelError, match="its base floats"):
        compare(PANDA.with_base(True), PANDA.with_base(True))
    with pytest.raises(ModelError, match="give a second model"):
        documentation_of(replace(PANDA, source=None, name="mine"))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(save_model(heavier({(6, 0): 0.5}), tmp_path / "learned.json"))
    assert main(["diff", path, "--json", "-"]) == 0  # against its documentation
    said = capsys.readouterr()
    assert json.loads(said.out)["joints"][6]["mass_kg"] == pytest.approx([0.7355, 1.2355], abs=1e-4)
    assert "panda_link7 0.7355 -> 1.236 kg" in said.err
    assert main(["diff", "panda", path, "--json", str(tmp_path / "diff.json")]) == 0
    assert json.loads((tmp_path / "diff.json").read_text())["hand_max_mm"] == 0.0
    for wrong, told in (
        (["diff", path, "pnada"], "panda"),
        (["diff", path, "panda", "--lock", "thumb=1"], "thumb"),
    ):
        capsys.readouterr()
        assert main(wrong) == 2
        assert told in capsys.readouterr().err
