"""What the README tells people to type works, word for word."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adapter.model.model_file import load_model, save_model
from adapter.model.robots import documented
from adapter.realtime import SnapshotWriter
from adapter.runs.config import read_config
from drivers.files.mcap import read_log
from tests.helpers.stalls import Stalls

PATIENCE_S = 1500.0  # with a command, on a machine with other work
pytestmark = [pytest.mark.alone, pytest.mark.timeout(2 * PATIENCE_S)]

ROOT = Path(__file__).parents[2]
LANES = 2  # commands at a time
SHELL = r"```sh\n(.*?)```"
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Fenced blocks of a language, in order."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands(block: str) -> list[str]:
    """The adapter's commands of a block, without comments."""
    lines = (line.partition("#")[0].strip() for line in block.splitlines())
    return [line for line in lines if line.startswith("adapter ")]


def environment(folder: Path) -> dict[str, str]:
    """As a shell has it in which the project's own was activated."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PANDA_ADAPTER_CACHE": str(folder / "cache")}


def give(line: str, folder: Path, codes: tuple[int, ...] = (0,)) -> tuple[int, str]:
    """Run a command line as a shell would; its exit code, one of these, and its complaints."""
    done = subprocess.run(
        shlex.split(line),
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode in codes, f"{line}\n{done.stderr}"
    return done.returncode, done.stderr


def chains(lines: list[str]) -> list[list[str]]:
    """The lines in groups: those after the first of a group read the folder that it writes."""
    found: dict[str, list[str]] = {}
    for line in lines:
        folder = re.findall(r"runs/\w+", line)[0]
        found.setdefault(folder, []).append(line)
    return list(found.values())


@pytest.fixture(scope="module")
def toured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the tour and the experiments were made, two commands at a time."""
    folder = tmp_path_factory.mktemp("tour")
    tour = commands(next(block for block in blocks("sh") if "runs/tour" in block))
    section = README.split("## The paper's experiments")[1].split("\n## ")[0]
    small = [line for block in re.findall(SHELL, section, re.DOTALL) for line in commands(block)]
    assert len(tour) >= 6 and len(small) >= 2

    def give_all(lines: list[str]) -> None:
        for line in lines:
            give(line, folder)

    with ThreadPoolExecutor(LANES) as lanes:  # the last group of the tour takes longest
        for done in [lanes.submit(give_all, lines) for lines in reversed(chains(tour + small))]:
            done.result()
    return folder


def test_the_tour(toured: Path) -> None:
    for name in ("tour", "again", "fast", "load", "bent", "forward", "gap"):
        assert (toured / "runs" / name / "report.html").exists()
    assert (toured / "panda_learned.urdf").exists()
    again, fast = (load_model(toured / "runs" / name / "model.json") for name in ("again", "fast"))
    live = load_model(toured / "runs" / "tour" / "model.json")
    assert (again.theta == live.theta).all() and (fast.theta != live.theta).any()


def test_the_gap(toured: Path) -> None:
    found = json.loads((toured / "gap.json").read_text())["findings"]
    coulomb = {j for f in found if f["effect"] == "coulomb_friction" for j in f["joints"]}
    assert coulomb == set(range(1, 8))


def test_finding_the_gap_from_python() -> None:
    code = next(block for block in blocks("python") if "find_gap" in block)
    short = ROOT / "recordings" / "panda_nominal_6s.mcap"
    exec(code.replace("runs/friction/recording.mcap", str(short)), {})


def test_the_paper_s_experiments(toured: Path) -> None:
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
HELD_UP_S = 2e-3  # a process or core that stands still for so long was held up by the machine
BY_THE_MACHINE = (
    r"missed 20 commands|silent for|answers? on|not answer|no usable joint reading|no state|"
    r"communication lost|no joint can move to|too fast"
)


def served(line: str, folder: Path) -> subprocess.Popen[str]:
    """A simulated arm started as the README says, on a port of its own, once it is ready."""
    arm = subprocess.Popen(
        [*shlex.split(line), "--port", str(PORT), "--json", "arm.json"],
        cwd=folder,
        env={**environment(folder), "PYTHONUNBUFFERED": "1"},
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
    """Its accounts balance; an arm that stopped says so, and only where processors were away."""
    section = README.split("## Simulated hardware")[1].split("\n## ")[0]
    shell = "".join(re.findall(SHELL, section, re.DOTALL))
    serve = next(line for line in commands(shell) if line.strip() == f"adapter sim {kind}")
    run = next(line for line in commands(shell) if f"{kind}://" in line)
    run = run.replace("127.0.0.1", f"127.0.0.1:{PORT}").replace("163.2?", f"163.2:{PORT}?")
    (tmp_path / "soon.toml").write_text("[excitation]\nslow_s = 2.0\n")
    arm = served(serve, tmp_path)
    with Stalls() as stalls:
        try:
            options = "--duration 2 --config soon.toml --out run --json run.json"
            code, said = give(f"{run} {options}", tmp_path, codes=(0, 2, 3))
        finally:
            arm.terminate()
            arm.communicate(timeout=30)
    if code == 2:  # before the loop had its priority: the motors' replies came too late
        assert re.search(f"error: .*({BY_THE_MACHINE})", said) and stalls.worst_s > HELD_UP_S
        return
    figures, seen = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("run", "arm"))
    intake = figures["intake"]
    assert intake["received"] == intake["used"] + sum(intake["refused"].values()) > 0
    assert figures["samples"] == figures["learned"] + sum(figures["refused"].values()) > 0
    assert figures["recorded"] + figures["unrecorded"] == figures["samples"]
    if kind == "fci":  # none that the robot does not know of
        assert intake["received"] <= seen["states_sent"]
    if code == 0:
        assert figures["fault"] is None and figures["ended"] == "duration"
        assert figures["samples"] > 3000
        return
    assert figures["ended"] == "driver_error" and "\n" not in figures["fault"]
    assert re.search(BY_THE_MACHINE, figures["fault"]), figures["fault"]
    simulator_s = 1e-3 * (seen["stalled_ms"] if kind == "fci" else seen["slipped_ms"])
    loop_s = 1e-6 * figures["timing"]["period_us"]["max"]
    assert max(stalls.worst_s, simulator_s, loop_s) > HELD_UP_S


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


def test_every_file_it_points_to_is_there() -> None:
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
