"""`adapter bench --log`: ways to learn side by side on a recording with something hidden."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.cli.main import main
from adapter.effects.robots import documented
from adapter.experiments import court
from adapter.experiments.rivals import WAYS, Given, Learned, Way, rigid, sysid
from adapter.physics.rigid_arm import RigidArm
from tests.helpers.gap_tools import pinocchio_recording, with_sines
from tests.hidden import draw, write


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording of an arm with a spring in joint 7, and the documented arm."""
    trial = replace(with_sines(draw(4, effect="joint_spring", rubs=False)), seconds=8.0)
    folder = tmp_path_factory.mktemp("court")
    log, model, _ = write(trial, folder, pinocchio_recording(trial), "pinocchio")
    return log, model


def test_all_ways_are_judged_on_one_log_and_those_that_are_missing_told(
    files: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(court, "MOST_STARTS", 2)
    monkeypatch.delitem(WAYS, "adapter replay")  # tested where it lives
    figures = tmp_path / "figures.json"
    log, model = map(str, files)
    more = ["--rounds", "1", "--json", str(figures), "--out", str(tmp_path)]
    assert main(["bench", "--log", log, "--robot", model, *more]) == 0
    found = json.loads(figures.read_text())
    ways = {row["way"]: row for row in found["ways"]}
    assert list(ways) == list(WAYS)
    for name, (_, module) in WAYS.items():
        there = module is None or importlib.util.find_spec(module) is not None
        assert ways[name]["ran"] == there, ways[name]["notes"]
        if not there:
            assert "panda-adapter[peers]" in ways[name]["notes"][0]
    ours, plain = (np.array(ways[x]["torque_nm"]) for x in (court.OURS, "least squares"))
    assert np.linalg.norm(ours) <= np.linalg.norm(plain)
    assert "joint_spring 7" in ways[court.OURS]["names"]
    assert ways[court.OURS]["cpu_s"] > 0.0 and ways[court.OURS]["peak_mb"] > 50.0
    off = np.array(ways[court.OURS]["off_m"], float)
    assert (np.diff(off[:3]) > 0.0).all()  # the longer, the farther
    assert "Least unseen torque, by joint: " in capsys.readouterr().out
    page = (tmp_path / "court.html").read_text()
    assert all(name.replace("'", "&#39;") in page for name in WAYS)


def test_a_way_that_crashes_or_takes_too_long_is_told(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = Given(None, documented("panda"), 1)
    assert "AttributeError" in court.in_a_process("least squares", given, 300.0)
    assert court.in_a_process("as documented", given, 0.1) == "not done after 0.1 s (--limit)"
    monkeypatch.setitem(WAYS, "gone", Way(Learned, "no_such_module"))
    assert "not installed" in court.in_a_process("gone", given, 1.0)


def test_rollouts_of_the_truth_follow_it() -> None:
    """Held against another way to say where the hand is: the regressor's own frames."""
    model = documented("panda")
    q = np.array([[0.0, -0.7, 0.0, -2.3, 0.0, 1.6, 0.8]])
    step = 1e-6 * np.eye(7)[3]
    moved = np.linalg.norm(court.hand_at(model, q + step) - court.hand_at(model, q))
    assert 0.3e-6 < moved < 0.9e-6  # the elbow is some 0.6 m from the hand


def test_sysid_finds_friction() -> None:
    model, wave = rigid(documented("panda")), 3e-3 * np.arange(1000)[:, None] * np.ones(7)
    q, dq, ddq = 0.1 * np.sin(wave) - 0.5, 0.3 * np.cos(wave), -0.9 * np.sin(wave)
    tau = RigidArm.of(model).torque(q, dq, ddq) + 2.0 * dq * np.eye(7)[0]  # N m s/rad
    found, (before, after) = sysid(model, [(q, dq, tau)], {"viscous_friction": [0]}, 5)
    assert after < 0.1 * before
    assert found.effects[0]["parameters"]["Fv"][0] == pytest.approx(2.0, rel=0.02)


def test_what_cannot_be_is_refused_in_a_sentence(
    files: tuple[Path, Path], refused, tmp_path: Path
) -> None:
    log, model = map(str, files)
    said = refused("bench", "--log", log, "--robot", model, "--only", "adaptor gap")
    assert "adapter gap" in said
    assert "--hold-out" in refused("bench", "--hold-out", log)
    assert "outside" in refused("bench", "--log", log, "--robot", model, "--validate-from", "99")
