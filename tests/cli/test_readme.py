"""What the README tells people to type works, word for word."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapter.model.model_file import load_model
from adapter.realtime import SnapshotWriter
from adapter.runs.config import read_config
from drivers.files.mcap import read_log
from tests.helpers.stalls import Stalls

pytestmark = pytest.mark.alone

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Fenced blocks of a language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands(block: str) -> list[str]:
    """The adapter's commands of a block, without comments."""
    lines = (line.partition("#")[0].strip() for line in block.splitlines())
    return [line for line in lines if line.startswith("adapter ")]


def give(line: str, folder: Path, codes: tuple[int, ...] = (0,)) -> None:
    """Run a command line as a shell with the environment activated would."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        shlex.split(line),
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode in codes, f"{line}\n{done.stderr}"


@pytest.fixture(scope="module")
def toured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the five-minute tour was taken."""
    folder = tmp_path_factory.mktemp("tour")
    tour = next(block for block in blocks("sh") if "runs/tour" in block)
    assert len(commands(tour)) >= 6
    for line in commands(tour):
        give(line, folder)
    return folder


def test_the_tour(toured: Path) -> None:
    for name in ("tour", "again", "fast", "load", "bent", "forward", "gap"):
        assert (toured / "runs" / name / "report.html").exists()
    assert (toured / "panda_learned.urdf").exists()


def test_the_gap(toured: Path) -> None:
    found = json.loads((toured / "gap.json").read_text())["findings"]
    coulomb = {j for f in found if f["effect"] == "coulomb_friction" for j in f["joints"]}
    assert coulomb == set(range(1, 8))
    code = next(block for block in blocks("python") if "find_gap" in block)
    short = ROOT / "recordings" / "panda_nominal_6s.mcap"
    exec(code.replace("runs/friction/recording.mcap", str(short)), {})


def test_the_paper_s_experiments(toured: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANDA_ADAPTER_CACHE", str(toured / "cache"))
    section = README.split("## The paper's experiments")[1].split("\n## ")[0]
    for shell in re.findall(r"```sh\n(.*?)```", section, re.DOTALL):
        for line in commands(shell):
            give(line, toured)
    assert (toured / "runs" / "small" / "experiment.html").exists()
    assert load_model(toured / "runs" / "found.json").tree.parent == (-1, 0, 1, 2, 3, 4, 5)


def test_your_own_log(toured: Path) -> None:
    log = read_log(toured / "runs" / "tour" / "recording.mcap")
    seconds = 1e-9 * log.stamp_ns[:, None]
    table = np.hstack([seconds, np.degrees(log.q), np.degrees(log.dq), log.tau])
    np.savetxt(toured / "log.csv", table, delimiter=",")
    shutil.copy(toured / "panda_learned.urdf", toured / "my_arm.urdf")
    block = next(block for block in blocks("sh") if "adapter import" in block)
    for line in commands(block):
        give(line, toured)


PORT = 14337  # instead of the usual ones, which something else may use
STALL_S = 0.01  # of this machine, from which on an arm may stop


def served(line: str, folder: Path) -> subprocess.Popen[str]:
    """A simulated arm started as the README says, on a port of its own, once it is ready."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    arm = subprocess.Popen(
        [*shlex.split(line), "--port", str(PORT)],
        cwd=folder,
        env={**os.environ, "PATH": path, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert arm.stdout is not None
    for said in arm.stdout:
        if str(PORT) in said:
            return arm
    raise AssertionError(f"{line} ended with {arm.wait()}")


@pytest.mark.parametrize("kind", ["fci", "can"])
def test_simulated_hardware(kind: str, tmp_path: Path) -> None:
    section = README.split("## Simulated hardware")[1].split("\n## ")[0]
    shell = "".join(re.findall(r"```sh\n(.*?)```", section, re.DOTALL))
    serve = next(line for line in commands(shell) if line.strip() == f"adapter sim {kind}")
    run = next(line for line in commands(shell) if f"{kind}://" in line)
    run = run.replace("127.0.0.1", f"127.0.0.1:{PORT}").replace("163.2?", f"163.2:{PORT}?")
    arm = served(serve, tmp_path)
    with Stalls() as stalls:
        try:
            options = f"--duration 2 --out {tmp_path}/run --json {tmp_path}/run.json"
            give(f"{run} {options}", tmp_path, codes=(0, 3))
        finally:
            arm.terminate()
            arm.communicate(timeout=30)
    figures = json.loads((tmp_path / "run.json").read_text())
    intake = figures["intake"]
    assert intake["received"] == intake["used"] + sum(intake["refused"].values()) > 0
    assert figures["samples"] == figures["learned"] + sum(figures["refused"].values()) > 0
    if figures["fault"] is None:
        assert figures["samples"] > 8000 and figures["ended"] == "duration"
    else:  # an arm rightly stops, and says why, when a shared machine is away for some 20 ms
        assert stalls.worst_s > STALL_S and figures["ended"] == "driver_error", figures["fault"]
        assert figures["fault"].strip() and "\n" not in figures["fault"]


def test_settings(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text(blocks("toml")[0])
    assert read_config(path).tool is not None


def test_learning_from_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code = next(block for block in blocks("python") if "adapter.learn(" in block)
    short = ROOT / "recordings" / "panda_nominal_6s.mcap"
    found: dict[str, Any] = {}
    exec(code.replace("runs/tour/recording.mcap", str(short)), found)
    assert np.abs(found["tau"] - found["state"].tau).max() < 1.0
    assert (tmp_path / "learned.urdf").exists()


def test_reading_the_estimate() -> None:
    writer = SnapshotWriter.create(("a", "b"), name="panda_adapter_readme")
    try:
        code = next(block for block in blocks("python") if "SnapshotReader" in block)
        exec(code.replace('"panda_adapter"', '"panda_adapter_readme"'), {})
    finally:
        writer.close()


def test_every_file_it_points_to_is_there() -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
