"""Logs of real arms: a Panda (Gaz et al. 2019) and a KUKA LWR4; the data are not the project's."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapter.cli import main

SHARED = Path(__file__).parents[2].parent / "shared"
pytestmark = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the folder of real logs is not beside the project"
)
# Torque RMSE of an identification tool's weighted least squares on the same log, N m.
TOOL = np.array([0.204, 0.251, 0.235, 0.201, 0.076, 0.041, 0.056])
SPLIT_S = 14.0


def give(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


@pytest.fixture(scope="module")
def panda_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Panda's log, imported as a user would."""
    path = tmp_path_factory.mktemp("panda") / "panda.mcap"
    start = SHARED / "data" / "panda_gaz2019" / "exciting_traj_"
    files = {"time": "time", "q": "positions", "dq": "velocity", "tau": "torques"}
    sources = [f"{signal}={start}{name}.txt" for signal, name in files.items()]
    give("import", *sources, "--flat", "--robot", "panda", "--to", path)
    return path


def replayed(path: Path, folder: Path, *options: object) -> dict[str, Any]:
    out = folder / "o.json"
    common = ("--quiet", "--no-report", "--out", folder, "--json", out)
    give("replay", path, *common, *options)
    return json.loads(out.read_text())


def test_panda_in_one_pass(panda_log: Path, tmp_path: Path) -> None:
    figures = replayed(panda_log, tmp_path, "--validate-from", SPLIT_S)
    assert figures["lambda"]["converged_s"] < 3.0
    assert figures["lambda"]["source"] == "reproduces the documentation"
    error = np.array(figures["theta"]["validation_torque_rmse_nm"])
    assert (error <= 0.92 * TOOL).all(), error / TOOL
    assert figures["theta"]["changes"] == []  # bursts where friction reverses are no loads
    assert figures["refused"]["repeated"] > 700
    friction = np.array(figures["theta"]["effects"]["bristle_friction"])
    assert (friction > 0.1).all() and (friction < 0.6).all()


@pytest.mark.parametrize(("split_s", "every", "share"), [(10.0, 1, 1.0), (SPLIT_S, 20, 0.92)])
def test_panda_split_sooner_and_in_batches(
    panda_log: Path, tmp_path: Path, split_s: float, every: int, share: float
) -> None:
    """After 10 s comes the largest swing of joint 6, which nothing before it shows."""
    figures = replayed(panda_log, tmp_path, "--validate-from", split_s, "--every", every)
    error = np.array(figures["theta"]["validation_torque_rmse_nm"])
    assert (error <= share * TOOL).all(), error / TOOL


@pytest.mark.slow
def test_kuka(tmp_path: Path) -> None:
    folder = SHARED / "data" / "lwr4"
    urdf, path = folder / "kuka_lwr4.urdf", tmp_path / "kuka.mcap"
    give("import", folder / "measurements_1.npz", "--robot", urdf, "--to", path)
    figures = replayed(path, tmp_path, "--robot", urdf, "--validate-from", 18.0)
    assert figures["lambda"]["converged_s"] < 3.0
    error = np.array(figures["theta"]["validation_torque_rmse_nm"])
    assert (error < 0.5).all(), error  # N m, of torques of up to 60
