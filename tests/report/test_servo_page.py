"""The page of a position-controlled arm: what it says, and that it stands alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.gap.result import RolloutCurves
from adapter.gap.servo_kernels import Ground
from adapter.gap.servo_model import ServoModel
from adapter.gap.servo_result import WITH_FRICTION, ServoFinding, ServoGap
from adapter.gap.servo_words import as_json, lines
from adapter.report.servo_page import render_servo_page
from tests.helpers.browser import ids_of_a_whole_page, laid_out, text_of

NAMES = ("pan", "lift", "jaw")
TABLE = Ground(1, np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]), -0.02, 20.0)


def found() -> ServoGap:
    """Three joints: one explained, one not where it is slow, one worse than before."""
    t = np.arange(0.0, 30.0, 0.02)
    q = np.sin(t)[:, None] * [0.5, 0.4, 0.3]
    before, after = (q + np.array(x) for x in ((0.05, 0.06, 0.002), (0.001, 0.0, 0.004)))
    slow = np.abs(np.cos(t)) < 0.2
    after[slow, 1] += 0.05
    rows = RolloutCurves(t, q, before, after)
    gains = np.array([10.0, 12.0, 3.0])
    servos = replace(ServoModel.ideal(NAMES), position_gain=gains, delay_s=0.003)
    documented = None, 14.0, None
    findings = (
        ServoFinding(
            "servo_position_gain", (1, 2, 3), (10.0, 12.0, 3.0), (0.1, 0.2, 2.0), documented, "N m"
        ),
        ServoFinding("servo_velocity_gain", (2,), (0.8,), (0.02,), (None,), "N m s", WITH_FRICTION),
        ServoFinding("servo_delay", (1, 2, 3), (3e-3,) * 3, (1e-4,) * 3, (0.0,) * 3, "s"),
    )
    return ServoGap(
        NAMES,
        "arm",
        ("a.mcap", "b.mcap", "c.mcap"),
        findings,
        servos,
        (("b.mcap", rows), ("c.mcap", replace(rows, after=after + np.array([0.0, 0.0, 0.05])))),
        "2 recordings held out",
        "gripper",
        np.array([5e-3, 1e-2, 0.0, 1.1e-2]),
        np.array([1e-4, 2e-3, 0.0, 2e-3]),
        scale_open=(3,),
        ground=TABLE,
        touched=(2.0,),
        notes=("a note",),
    )


def test_the_page_says_what_was_found_and_what_to_do() -> None:
    page = render_servo_page(found(), "arm.urdf", Path("runs/gap/servo.toml"))
    ids_of_a_whole_page(page, "gap findings moments trust next notes provenance")
    said = text_of(page)
    for part in (
        "at the hand 11 mm → 2.0 mm (2 recordings held out).",
        "The hand came down on something about 2 cm below",
        "commands act 3.00 ms late",
        "12.00 ± 0.20, not 14.0",
        "joint 3: not better",
        "joints 2 and 3: more than a quarter of the error and 4 mrad",
        "Joint 2: what is left is where it is slow",
        "Joint 3: what is left is where it is fast",
        "Record a second motion that touches the table",
        "Joint 3: move it with a known mass",
        "adapter export arm.urdf --servo runs/gap/servo.toml --mjcf arm.xml",
        "Joint 3, jaw rad", "of c.mcap",
    ):  # fmt: skip
        assert part in said.replace("\u202f", " ").replace("\u00a0", " "), part
    assert "<h1>Tracking error of the worst joint" in page
    sliding = replace(found(), slides=(False, False, True))
    of_it = text_of(render_servo_page(sliding, "arm", Path("x.toml")))
    assert "Joint 3, jaw m " in of_it and "mrad (mm of joint 3) rms" in of_it
    assert said.index("Joint 3, jaw") < said.index("Joint 2, lift") < said.index("Joint 1, pan")


def test_an_arm_as_documented_has_a_page_without_findings() -> None:
    nothing = replace(
        found(), findings=(), ground=TABLE._replace(root=0.0), scale_open=(), notes=()
    )
    page = render_servo_page(nothing, "arm.urdf", Path("servo.toml"))
    ids_of_a_whole_page(page, "gap moments trust next provenance")
    assert "The arm does what its servos' documentation says" in text_of(page)


@pytest.mark.parametrize("width", [420, 1500])
def test_the_page_lies_within_its_width(width: int, tmp_path: Path) -> None:
    page = render_servo_page(found(), "arm.urdf", Path("servo.toml"))
    assert laid_out(page, tmp_path, width) > 0


def test_the_hand_stands_in_the_terminal_and_in_the_figures() -> None:
    gap = found()
    rows = [
        line.split() for line in lines(gap) if line.startswith(("at the hand", "            af"))
    ]
    assert [row[-4:] for row in rows] == [
        ["5.00", "10.0", "0", "11.0"],
        ["0.100", "2.00", "0", "2.00"],
    ]
    after = as_json(gap)["after"]
    assert after["hand_rmse_m"] == 2e-3 and len(after["hand_rmse_by_joint_m"]) == 3
