"""What README and pages tell people to type works, word for word."""

import json
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapter.cli.exit_codes import ExitCode
from adapter.model.model_file import load_model, save_model
from adapter.model.robots import documented
from adapter.realtime import SnapshotWriter
from adapter.runs.config import read_config
from drivers.files.mcap import read_log
from tests.helpers.pages import PATIENCE_S, ROOT, blocks, give, given

pytestmark = [pytest.mark.alone, pytest.mark.timeout(2 * PATIENCE_S)]

SHORT = ROOT / "recordings" / "panda_nominal_6s.mcap"

# What of the tour is done for a shorter time here, for it takes as long as it says
BRIEFLY = {
    "--duration 15": "--duration 7",
    "--duration 24": "--duration 3",  # nothing is picked up
    "--duration 10": "--duration 5",
    "--duration 12": "--duration 3",
    "--duration 40": "--duration 3",
    "--duration 20": "--duration 12",
    "--validate-from 14": "--validate-from 6",
}

FOLDER = re.compile(r"runs/\w+")  # that a command writes, or goes on from
TOUR = [line for line in given() if FOLDER.search(line)]
OWN_LOG = [line for line in given() if not FOLDER.search(line)]  # of a table, in this folder


def brief(line: str) -> str:
    """A command line for a shorter run, or for the log of one."""
    for said, done in BRIEFLY.items():
        line = line.replace(said, done)
    return line


def chains(lines: list[str]) -> list[list[str]]:
    """The lines in groups: those after the first of a group read the folder that it writes."""
    found: dict[str, list[str]] = {}
    for line in lines:
        found.setdefault(FOLDER.findall(line)[0], []).append(line)
    return list(found.values())


@pytest.fixture(scope="module")
def toured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which all commands that write results were given, two at a time."""
    folder = tmp_path_factory.mktemp("tour")
    (folder / "recordings").symlink_to(ROOT / "recordings")
    assert len(TOUR) >= 8
    assert all(any(said in line for line in given()) for said in BRIEFLY)

    def give_all(lines: list[str]) -> None:
        for line in lines:
            give(brief(line), folder, (ExitCode.DONE, ExitCode.NOT_CONVERGED))

    with ThreadPoolExecutor(2) as lanes:  # the last groups take longest
        for done in [lanes.submit(give_all, lines) for lines in reversed(chains(TOUR))]:
            done.result()
    return folder


def test_the_tour(toured: Path) -> None:
    for name in ("tour", "again", "fast", "load", "bent", "forward", "gap"):
        assert (toured / "runs" / name / "report.html").exists()
    assert (toured / "panda_learned.urdf").exists()
    assert (toured / "runs" / "fleet" / "fleet.html").exists()
    assert load_model(toured / "runs" / "found.json").tree.parent == (-1, 0, 1, 2, 3, 4, 5)
    again, fast = (load_model(toured / "runs" / name / "model.json") for name in ("again", "fast"))
    live = load_model(toured / "runs" / "tour" / "model.json")
    assert (again.theta == live.theta).all() and (fast.theta != live.theta).any()


def test_the_gap(toured: Path) -> None:
    found = json.loads((toured / "runs" / "gap" / "gap.json").read_text())["findings"]
    coulomb = {j for f in found if f["effect"] == "coulomb_friction" for j in f["joints"]}
    assert coulomb == set(range(1, 8))


def test_finding_the_gap_from_python() -> None:
    code = next(block for block in blocks("python") if "find_gap" in block)
    exec(code.replace("runs/friction/recording.mcap", str(SHORT)), {})


def test_your_own_log(toured: Path) -> None:
    log = read_log(toured / "runs" / "tour" / "recording.mcap")
    seconds = 1e-9 * log.stamp_ns[:, None]
    table = np.hstack([seconds, np.degrees(log.q), np.degrees(log.dq), log.tau])
    np.savetxt(toured / "log.csv", table, delimiter=",")
    for name in ("states", "commands"):  # of a servo that follows at once
        head = ",".join(["time", *(f"q_{k}" for k in range(7))])
        np.savetxt(toured / f"{name}.csv", table[:, :8], delimiter=",", header=head)
    shutil.copy(toured / "panda_learned.urdf", toured / "my_arm.urdf")
    assert len(OWN_LOG) >= 3
    for line in OWN_LOG:
        give(brief(line), toured)


def test_settings(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text(blocks("toml", "docs/commands.md")[0])
    assert read_config(path).tool is not None


def test_learning_from_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code = next(block for block in blocks("python") if "adapter.learn(" in block)
    found: dict[str, Any] = {}
    exec(code.replace("runs/tour/recording.mcap", str(SHORT)), found)
    assert np.abs(found["tau"] - found["state"].tau).max() < 1.0
    assert (tmp_path / "learned.urdf").exists()


@pytest.mark.parametrize("call", ["hour.mcap", "AnyReader", "adapter.Told("])
def test_reading_a_recording_from_python(call: str) -> None:
    code = next(block for block in blocks("python") if call in block)
    for said in ("hour.mcap", "runs/tour/recording.mcap"):
        code = code.replace(said, str(SHORT))
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["message"] is not None if call == "AnyReader" else len(names["log"]) > 1000


def test_simulating_with_the_effects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "gap").mkdir(parents=True)
    friction = {"effect": "coulomb_friction", "joints": [2], "parameters": {"Fc": 0.5}}
    offset = {"effect": "torque_offset", "joints": [1], "parameters": {"o": 0.4}}
    save_model(replace(documented("panda"), effects=(friction, offset)), "runs/gap/model.json")
    names: dict[str, Any] = {}
    exec(next(block for block in blocks("python") if "MujocoArm" in block), names)
    assert names["tau"].tolist() == [0.4, *[0.0] * 6]
    assert (names["dq"] != 0.0).sum() >= 5 and abs(names["q"][1] + 0.8) < 1e-4


def test_reading_the_estimate() -> None:
    writer = SnapshotWriter.create(("a", "b"), name="panda_adapter_readme")
    try:
        code = next(block for block in blocks("python") if "SnapshotReader" in block)
        exec(code.replace('"panda_adapter"', '"panda_adapter_readme"'), {})
    finally:
        writer.close()
