"""A driver of the user's own, named by its file: it is run, or told what it lacks."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from adapter.cli import main
from drivers.interface import DriverError
from drivers.registry import open_driver

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "write_a_driver.py"
NAMES = ("a", "b")
WHOLE = """
from drivers.interface import Intake
from beside import HZ

class Arm:
    link_names, period_ns, delay_ns, arrived_ns = (), 10**9 // HZ, 0, 0
    paced, adds_gravity = True, False

    def __init__(self, joint_names, host="nobody", allow_motion=False):
        self.joint_names, self.host, self.can_move = tuple(joint_names), host, allow_motion
        self.intake = Intake()

    def connect(self): ...
    def read(self): ...
    def command(self, tau): ...
    def stop(self): ...
    def close(self): ...
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "beside.py").write_text("HZ = 500\n")
    path = tmp_path / "my_arm.py"
    path.write_text(WHOLE)
    return path


def test_it_is_made_with_what_it_takes(file: Path) -> None:
    arm = open_driver(f"{file}:Arm?host=10.0.0.2", {}, NAMES, True)
    assert vars(arm)["host"] == "10.0.0.2" and arm.joint_names == NAMES
    assert arm.can_move and arm.period_ns == 2_000_000
    assert not open_driver(f"{file}:Arm", {}, NAMES, False).can_move


@pytest.mark.parametrize(
    "change, address, said",
    [
        (("", ""), ":Amr", "no driver 'Amr'; have: Arm; did you mean Arm"),
        (("", ""), ":Arm?port=3", "cannot be made of .*unexpected keyword argument 'port'"),
        (("    def stop(self): ...\n", ""), ":Arm", "Arm lacks stop"),
        (("tuple(joint_names)", "('b', 'a')"), ":Arm", "its joints are b, a, the robot's a, b"),
        (("allow_motion\n", "True\n"), ":Arm", "nobody allowed motion"),
    ],
)
def test_what_is_wrong_is_said(
    file: Path, change: tuple[str, str], address: str, said: str
) -> None:
    file.write_text(file.read_text().replace(*change) if change[0] else file.read_text())
    with pytest.raises(DriverError, match=said):
        open_driver(f"{file}{address}", {}, NAMES, False)


def test_a_run_learns_behind_it(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(EXAMPLE.parents[2])
    figures = tmp_path / "out.json"
    out = ["--duration", "5", "--out", str(tmp_path / "run"), "--json", str(figures)]
    mine = ["run", "--driver", f"{EXAMPLE}:MyArm", "--robot", "panda", "--allow-motion", "--yes"]
    assert main([*mine, *out]) == 0
    assert json.loads(figures.read_text())["samples"] > 4000
    told = capsys.readouterr()
    assert "--allow-motion changes nothing here" in told.err  # it has no command to give
    assert "--allow-motion" not in told.out
    assert main(["run", "--driver", f"{EXAMPLE}:MyArm", "--allow-motion"]) == 2
    assert "--robot must" in capsys.readouterr().err
    assert main(["run", "--driver", "nobody.py:MyArm"]) == 2
    assert main(["run", "--driver", "mine://x"]) == 2
    told = capsys.readouterr().err
    assert "nobody.py: cannot be read" in told and "FILE.py:CLASS of your own" in told
