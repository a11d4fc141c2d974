"""`adapter gap` as a user gives it: what it writes, what it refuses, what it measures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapter.cli import main
from adapter.effects.torque import ModelTorque
from adapter.gap.held_out import rms, rollout_errors
from adapter.gap.signals import COMMANDS, MEASURED, Recorded
from adapter.model.model_file import load_model, save_model
from adapter.model.robots import documented
from adapter.model.self_model import SelfModel, Tool
from adapter.signals.validation import rms_of, validation_error
from adapter.simulate import SIMULATORS, Rollouts
from drivers.files.mcap import Log, read_log, write_log
from sim.effects import Effect
from tests.helpers.gap_tools import believed, pinocchio_recording
from tests.hidden import Trial, draw, nominal_urdf, pybullet_recording

COULOMB = Effect("coulomb_friction", (4,), {"Fc": 2.0})
KEYS = {"noise_floor_nm", "before", "after", "findings", "unexplained", "model_out"}
GAP_KEYS = {"torque_rmse_nm", "rollout_rmse_rad"}


def trial(seed: int, seconds: float, effects: Sequence[Effect] = (COULOMB,)) -> Trial:
    return replace(believed(seed), seconds=seconds, effects=tuple(effects))


def gap(folder: Path, model: Path | str, logs: Sequence[Path], *options: object) -> dict[str, Any]:
    """Run the command; its exit code (key `exit`) and what it wrote."""
    figures = folder / "figures.json"
    words = ["gap", *logs, "--robot", model, "--json", figures, "--out", folder / "out", "--quiet"]
    code = main([str(word) for word in (*words, *options)])
    return {"exit": code, **json.loads(figures.read_text())}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the nominal model and two recordings of an arm with friction on joint 4."""
    folder = tmp_path_factory.mktemp("gap")
    first = trial(5, 12.0)
    (folder / "arm.urdf").write_text(nominal_urdf(first.nominal))
    write_log(pinocchio_recording(first), folder / "one.mcap", {})
    again = replace(first, motion=trial(6, 12.0).motion, seconds=8.0)
    write_log(pinocchio_recording(again), folder / "two.mcap", {})
    return folder


@pytest.fixture(scope="module")
def found(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("found")
    return folder, gap(folder, data / "arm.urdf", [data / "one.mcap"])


def changed(data: Path, to: Path, **signals: Any) -> Path:
    """The first recording with other signals."""
    write_log(replace(read_log(data / "one.mcap"), **signals), to, {})
    return to


def coulomb_on_joint_4(figures: dict[str, Any]) -> float:
    """The size of the one finding."""
    named = [(f["effect"], f["joints"]) for f in figures["findings"]]
    assert named == [("coulomb_friction", [4])]
    return float(figures["findings"][0]["parameters"]["Fc"])


def test_figures(found: tuple[Path, dict[str, Any]]) -> None:
    _, figures = found
    assert figures["exit"] == 0 and figures["problem"] is None
    assert figures.keys() >= KEYS
    assert len(figures["noise_floor_nm"]) == 7
    for when in ("before", "after"):
        assert figures[when].keys() >= GAP_KEYS
        assert all(len(figures[when][key]) == 7 for key in GAP_KEYS)
    assert coulomb_on_joint_4(figures) == pytest.approx(2.0, rel=0.05)
    told = "effect joints interval_s parameters std units evidence ambiguous_with split_by"
    assert figures["findings"][0].keys() >= {*told.split()}
    assert figures["after"]["torque_rmse_nm"][3] < 0.2 * figures["before"]["torque_rmse_nm"][3]
    assert figures["after"]["rollout_rmse_rad"][3] < 0.5 * figures["before"]["rollout_rmse_rad"][3]


def test_the_new_model_explains_more_and_the_old_one_stays(
    data: Path, found: tuple[Path, dict[str, Any]]
) -> None:
    folder, figures = found
    assert (data / "arm.urdf").read_text() == nominal_urdf(draw(5, "null").nominal)
    assert Path(figures["model_out"]) == folder / "out" / "model.json"
    assert all((folder / "out" / name).exists() for name in ("model.urdf", "gap.json"))
    page = folder / "out" / "report.html"
    assert figures["report"] == str(page) and "Coulomb friction" in page.read_text()
    log = read_log(data / "two.mcap")
    signals = 1e-9 * log.stamp_ns, log.q, log.dq, log.tau
    old, new = (
        rms_of([validation_error(*signals, ModelTorque(model))]).value
        for model in (documented(data / "arm.urdf"), load_model(figures["model_out"]))
    )
    assert new[3] < 0.2 * old[3] and (new < 1.1 * old).all()


def test_a_model_is_never_written_over(data: Path, tmp_path: Path, refused) -> None:
    model = save_model(documented(data / "arm.urdf"), tmp_path / "model.json")
    before = model.read_bytes()
    refused("gap", data / "one.mcap", "--robot", model, "--out", tmp_path)
    assert model.read_bytes() == before


def test_too_little_motion(data: Path, tmp_path: Path) -> None:
    log = read_log(data / "one.mcap")
    noise = np.random.default_rng(1).normal(0.0, 1e-4, log.q.shape)
    path = changed(data, tmp_path / "still.mcap", q=log.q[:1] + noise, dq=10.0 * noise)
    figures = gap(tmp_path, data / "arm.urdf", [path])
    assert figures["exit"] == 0 and figures["findings"] == []
    assert "too little motion" in figures["problem"] and "move panda_joint1" in figures["problem"]
    assert figures["model_out"] is None
    assert "too little motion" in (tmp_path / "out" / "report.html").read_text()


def test_another_robot(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = tuple(f"lbr_{name}" for name in "abcdefg")
    path = changed(data, tmp_path / "other.mcap", joint_names=names)
    figures = gap(tmp_path, data / "arm.urdf", [path])
    assert figures["exit"] == 2 and figures["findings"] == figures["unexplained"] == []
    said = " ".join(capsys.readouterr().err.split())
    for name in (*names, *documented(data / "arm.urdf").tree.joint_names):
        assert name in figures["problem"] and name in said
    assert not (tmp_path / "out" / "model.json").exists()


def test_validate_from(data: Path, tmp_path: Path, refused) -> None:
    options = "--validate-from", 8.0, "--no-simulation", "--no-report"
    figures = gap(tmp_path, data / "arm.urdf", [data / "one.mcap"], *options)
    assert figures["exit"] == 0
    assert coulomb_on_joint_4(figures) == pytest.approx(2.0, rel=0.05)
    assert figures["before"]["rollout_rmse_rad"] is None and "report" not in figures
    assert figures["after"]["torque_rmse_nm"][3] < 0.2 * figures["before"]["torque_rmse_nm"][3]
    assert not (tmp_path / "out" / "report.html").exists()
    words = ["gap", data / "one.mcap", "--robot", data / "arm.urdf", "--out", tmp_path]
    refused(*words, "--validate-from", 11.0)


def test_one_of_two_recordings_is_held_out(data: Path, tmp_path: Path) -> None:
    options = "--hold-out", data / "one.mcap", "--no-simulation", "--no-report"
    figures = gap(tmp_path, data / "arm.urdf", [data / "two.mcap"], *options)
    assert figures["exit"] == 0 and figures["recordings"] == ["two.mcap", "one.mcap"]
    assert coulomb_on_joint_4(figures) == pytest.approx(2.0, rel=0.05)
    log = read_log(data / "one.mcap")
    signals = 1e-9 * log.stamp_ns, log.q, log.dq, log.tau
    model = ModelTorque(load_model(figures["model_out"]))
    ours = rms_of([validation_error(*signals, model)]).value
    np.testing.assert_allclose(figures["after"]["torque_rmse_nm"], ours, rtol=1e-3)


@pytest.fixture(scope="module")
def hidden() -> tuple[Trial, Log]:
    """What PyBullet recorded with its commands, without the torque that disturbs the arm."""
    arm = replace(trial(3, 6.0), commands=True, disturbance_nm=np.zeros(7))
    return arm, pybullet_recording(arm)


@pytest.fixture(scope="module")
def simulated(hidden: tuple[Trial, Log]) -> tuple[Recorded, SelfModel, SelfModel]:
    """The recording, and the arm's model without and with its effect."""
    nominal = replace(documented("panda"), theta=hidden[0].arm.theta)
    recorded = Recorded.of(hidden[1])
    return recorded, nominal, replace(nominal, effects=(COULOMB.as_dict(),))


def test_rollouts_of_the_command(hidden: tuple[Trial, Log], tmp_path: Path) -> None:
    write_log(hidden[1], tmp_path / "log.mcap", {})
    figures = gap(tmp_path, "panda", [tmp_path / "log.mcap"], "--simulator", "mujoco")
    assert coulomb_on_joint_4(figures) == pytest.approx(2.0, rel=0.05)
    assert figures["simulator"] == "mujoco"
    before, after = (np.array(figures[x]["rollout_rmse_rad"]) for x in ("before", "after"))
    assert after[3] < 0.2 * before[3] and (after < 0.3 * before).all()
    assert "forward simulation by mujoco" in (tmp_path / "out" / "report.html").read_text()
    recorded, model = Recorded.of(hidden[1]), load_model(figures["model_out"])
    nominal = documented("panda")
    both = [rollout_errors(recorded, nominal, [model], Rollouts(name)) for name in SIMULATORS]
    for key in ("before_q", "after_q"):
        mine, theirs = (rms([getattr(x, key)]) for x in both)
        np.testing.assert_allclose(mine, theirs, rtol=0.1)


def test_rollouts_by_commands_and_by_measured_torque(
    simulated: tuple[Recorded, SelfModel, SelfModel],
) -> None:
    recorded, nominal, true = simulated
    told = {}
    for drive, recording in (
        (COMMANDS, recorded),
        (MEASURED, replace(recorded, commands=None, command_t=None)),
    ):
        assert recording.drive(recording.grid())[1] == drive
        errors = rollout_errors(recording, nominal, [true], Rollouts())
        told[drive] = rms([errors.before_q]), rms([errors.after_q])
        assert told[drive][1][3] < 0.2 * told[drive][0][3]
    assert told[COMMANDS][1][3] < 0.05 * told[COMMANDS][0][3]


def test_a_tool_takes_part_in_rollouts(simulated: tuple[Recorded, SelfModel, SelfModel]) -> None:
    recorded, _, true = simulated
    theta = true.theta.copy()
    tool = Tool(0.1, np.array([0.0, 0.0, 0.05]), np.zeros((3, 3)))
    theta[-1] -= tool.theta()
    split = replace(true, theta=theta, tool=tool)
    errors = rollout_errors(recorded, split, [true], Rollouts())
    np.testing.assert_allclose(errors.before_q, errors.after_q, atol=1e-6)


def test_a_model_that_cannot_be_simulated(simulated: tuple[Recorded, SelfModel, SelfModel]) -> None:
    recorded, nominal, _ = simulated
    theta = nominal.theta.copy()
    theta[2, 0] = -1.0
    rollouts = Rollouts()
    errors = rollout_errors(recorded, replace(nominal, theta=theta), [nominal], rollouts)
    assert np.isnan(rms([errors.before_q])).all() and np.isnan(rms([errors.after_q])).all()
    assert len(rollouts.troubles) == 1 and "panda_link3" in rollouts.troubles[0]
