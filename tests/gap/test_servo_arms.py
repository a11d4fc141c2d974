"""Servos of several arms beside each other: the odd one is told, and no other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapter.cli import main
from adapter.errors import UsageError
from adapter.gap.servo_arms import beside
from adapter.gap.servo_result import EFFECTS
from tests.helpers.position_arm import Drawn, position_arm

JOINTS = ["a", "b", "c"]


def result(rng: np.random.Generator, odd: float = 1.0) -> dict[str, Any]:
    """Figures of an arm whose numbers are true but for their doubt; `odd` times gain of joint b."""
    findings = []
    for number, (effect, (_, key, unit)) in enumerate(EFFECTS.items()):
        true = (1.0 + number) * np.array([1.0, 2.0, 3.0])
        if number == 0:
            true[1] *= odd
        std = 0.01 * true * rng.uniform(0.5, 2.0, 3)
        values = true + std * rng.standard_normal(3)
        facts = {"parameters": {key: values.tolist()}, "std": {key: std.tolist()}}
        facts["units"] = {key: unit}
        findings.append({"effect": effect, "joints": [1, 2, 3], **facts})
    return {"joint_names": JOINTS, "findings": findings, "after": {"tracking_rmse_rad": [0.0] * 3}}


def kept(folder: Path, figures: dict[str, Any]) -> Path:
    folder.mkdir(exist_ok=True, parents=True)
    (folder / "gap.json").write_text(json.dumps(figures))
    return folder


@pytest.mark.parametrize("others", [1, 2, 5])
def test_the_odd_arm_is_told_and_no_other(others: int, tmp_path: Path) -> None:
    rng, wrong, right = np.random.default_rng(5), 0, 0
    for _ in range(40):
        paths = [kept(tmp_path / f"arm_{k}", result(rng)) for k in range(others)]
        numbers = beside(result(rng, odd=1.3), "new", paths)
        assert len(numbers) == 3 * len(EFFECTS) - 2  # one delay for all joints
        told = {(x.effect, x.joint): x.odd for x in numbers if x.odd}
        odd = told.pop(("servo_position_gain", 2), ())
        right += "new" in odd if others == 1 else odd == ("new",)
        wrong += len(told)
    assert right >= 39 and wrong <= 1


def test_what_is_no_such_result_is_refused(tmp_path: Path) -> None:
    own = result(np.random.default_rng(1))
    with pytest.raises(UsageError, match="no result of gap"):
        beside(own, "new", [tmp_path])
    other = kept(tmp_path / "other", {**own, "joint_names": ["a", "b"]})
    with pytest.raises(UsageError, match="its joints are a, b; this arm's a, b, c"):
        beside(own, "new", [other])


@pytest.mark.slow
def test_a_servo_of_another_batch_is_found_by_the_command(tmp_path: Path, capsys) -> None:
    """Two arms alike, and one whose joint 3 rubs half as much again."""
    for k in range(3):
        arm = position_arm(61, Drawn(8.0))
        if k == 2:
            arm.servos.coulomb[2] *= 1.5
        arm.moved("sines", 61 + k).write(tmp_path / f"{k}.mcap")
        words = ["gap", str(tmp_path / f"{k}.mcap"), "--robot", "panda", "--quiet"]
        words += ["--out", str(tmp_path / f"arm_{k}")]
        if k == 2:
            capsys.readouterr()
            words += ["--beside", str(tmp_path / "arm_0"), str(tmp_path / "arm_1")]
        assert main(words) == 0
    said = [x for x in capsys.readouterr().out.splitlines() if x.startswith("differs:")]
    assert len(said) == 1 and said[0].startswith("differs: arm_2: Coulomb friction of joint 3 is")
    assert "Beside other arms" in (tmp_path / "arm_2" / "report.html").read_text()
