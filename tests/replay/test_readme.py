"""What the README tells people to type works, word for word."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adapter.config import read_config
from adapter.realtime import SnapshotWriter
from drivers.mcap_file import read_log

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Fenced blocks of a language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands(block: str) -> list[str]:
    """The adapter's commands of a block, without comments."""
    lines = (line.partition("#")[0].strip() for line in block.splitlines())
    return [line for line in lines if line.startswith("adapter ")]


def give(line: str, folder: Path) -> None:
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
    assert done.returncode == 0, f"{line}\n{done.stderr}"


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
    code = next(block for block in blocks("python") if "analyse" in block)
    short = ROOT / "recordings" / "panda_nominal_6s.mcap"
    exec(code.replace("runs/friction/recording.mcap", str(short)), {})


def test_your_own_log(toured: Path) -> None:
    log = read_log(toured / "runs" / "tour" / "recording.mcap")
    seconds = 1e-9 * log.stamp_ns[:, None]
    table = np.hstack([seconds, np.degrees(log.q), np.degrees(log.dq), log.tau])
    np.savetxt(toured / "log.csv", table, delimiter=",")
    shutil.copy(toured / "panda_learned.urdf", toured / "my_arm.urdf")
    block = next(block for block in blocks("sh") if "adapter import" in block)
    for line in commands(block):
        give(line, toured)


def test_settings(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text(blocks("toml")[0])
    assert read_config(path).tool is not None


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
