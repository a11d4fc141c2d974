"""`adapter excite`: what it writes is the motion that it tells of, read by another's decoder."""

from __future__ import annotations

import json

import numpy as np
import pytest

from adapter.cli.main import build_parser, main
from adapter.cli.run import controller_of, run_plan
from adapter.control.designed import DesignedMotion
from adapter.control.limits import MotionLimits
from adapter.effects.phrases import LOADS, SPEEDS
from adapter.model.robots import documented
from tests.helpers.ros_messages import by_mcap_ros2

pytest.importorskip("coal")
LIMITS = MotionLimits.of(documented("panda"))
LOG = "recordings/panda_nominal_6s.mcap"


def _points(path):
    """Times (m,) s, q and dq (m, 7) of the one message of a recording."""
    found = by_mcap_ros2(path)
    ((_, message),) = found.pop("/joint_trajectory")
    assert not found and message["joint_names"] == list(documented("panda").tree.joint_names)
    points = message["points"]
    at = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
    return np.array(at), *(np.array([p[k] for p in points]) for k in ("positions", "velocities"))


def test_goes_on_from_a_log_and_writes_the_motion_three_times(tmp_path, capsys):
    line = ["excite", LOG, "--std", "2", "--rate", "100", "--longest", "30"]
    assert main([*line, "--out", str(tmp_path), "--json", str(tmp_path / "e.json")]) == 0
    told = capsys.readouterr().out
    table = np.genfromtxt(tmp_path / "motion.csv", delimiter=",", names=True)
    t, q, dq = _points(tmp_path / "motion.mcap")
    np.testing.assert_allclose(t, table["time_s"], atol=1e-6)
    np.testing.assert_allclose(q[:, 1], table["q_panda_joint2"], atol=1e-8)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], dq[1:-1], atol=0.03)
    assert np.diff(t) == pytest.approx(0.01)
    assert (q >= LIMITS.lower).all() and (q <= LIMITS.upper).all()
    played = ["plan", "--motion", str(tmp_path / "motion.csv"), "--out", str(tmp_path / "plan")]
    assert main(played) == 0 and "This moves 7 joints" in capsys.readouterr().out
    assert np.abs(dq[[0, -1]]).max() == 0.0 and np.abs(dq).max() > 0.5
    figures = json.loads((tmp_path / "e.json").read_text())
    assert t[-1] == pytest.approx(figures["seconds"] + 1.0, abs=0.05)
    shown = [row for row in figures["parameters"] if row["shown"]]
    assert len(shown) > 60 and all(row["std"] <= row["wanted"] for row in shown)
    assert f"{len(shown)} parameters" in told and (tmp_path / "plan.html").exists()


def test_makes_the_motion_that_a_gap_report_asks_for(tmp_path, capsys):
    report = {
        "findings": [
            {"split_by": f"{SPEEDS.do}: the one grows, the other stays", "joints": [2]},
            {"split_by": f"{LOADS.do}: the one grows", "joints": [4]},
        ]
    }
    path = tmp_path / "gap.json"
    path.write_text(json.dumps(report))
    assert main(["excite", "--gap", str(path), "--out", str(tmp_path), "--rate", "50"]) == 0
    captured = capsys.readouterr()
    assert "panda_joint2: move the joint at constant speeds" in captured.out
    assert "No motion alone does this: repeat the motion with a ladder of loads" in captured.err
    _, q, _ = _points(tmp_path / "motion.mcap")
    moved = np.ptp(q, axis=0) > 1e-6
    assert moved.tolist() == [False, True, False, False, False, False, False]
    np.testing.assert_allclose(q[-1], q[0], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--at", "0,1"], "needs 7 finite numbers, got 2"),
        (["--at", "a,b"], "takes numbers, with commas between"),
        (["--at", "0,1.5,0,-0.2,0,1.5,0"], "no motion can start at 0.00, 1.50"),
        (["--std", "0"], "--std must be above 0"),
        (["--gap", LOG], "not the JSON of `adapter gap`"),
    ],
)
def test_wrong_use_is_one_sentence(options, said, tmp_path, refused):
    assert said in refused("excite", *options, "--out", tmp_path)


def test_run_follows_a_designed_motion_with_the_documented_model():
    args = build_parser().parse_args(["run", "--excitation", "designed", "--move", "panda_joint4"])
    plan = run_plan(args)
    arm = plan.open(args.driver, False)
    controller = controller_of(args, plan, arm)
    arm.connect()
    try:
        controller.prepare(arm.read())
        assert isinstance(controller.reference, DesignedMotion)
        errors = []
        for _ in range(3000):
            sample = arm.read()
            arm.command(controller.step(sample))
            errors.append(np.abs(sample.q - controller.reference.q))
        moved = np.abs(controller.reference.q - controller.start.q)
    finally:
        arm.close()
    assert plan.feedforward == "documented" and np.max(errors) < 0.03
    assert moved[3] > 0.01 and np.delete(moved, 3).max() == 0.0
    random = run_plan(build_parser().parse_args(["run"]))
    assert random.feedforward == "none"
