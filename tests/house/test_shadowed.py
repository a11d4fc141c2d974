"""A script beside a `drivers.py` and a `sim` of its own gets those, and `adapter` gets ours."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import adapter
from adapter.shadowed import own_name

ROOT = Path(__file__).parents[2]
SCRIPT = """
import json, pickle, sys
import drivers
import adapter
import sim, sim.dynamics

if __name__ == "__main__":
    from adapter.cli import main
    from adapter.drivers.interface import JointSample
    log = adapter.read_log(sys.argv[1])
    twice = pickle.loads(pickle.dumps(log))
    code = main(["run", "--duration", "0.5", "--scenario", "friction", "--fault", "lost=0.01",
                 "--no-report", "--quiet", "--out", "out"])
    print(json.dumps({
        "run": code,
        "log": [type(log).__module__, type(twice) is type(log)],
        "sample": JointSample.__module__,
        "mine": [drivers.COLOUR, sim.SPEED, sim.dynamics.FRAMES],
    }))
"""


def test_files_of_the_users_own_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "drivers.py").write_text("import adapter\nCOLOUR = 'green'\n")
    (tmp_path / "sim").mkdir()
    (tmp_path / "sim" / "__init__.py").write_text("SPEED = 3\n")
    (tmp_path / "sim" / "dynamics.py").write_text("FRAMES = 24\n")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    log = ROOT / "recordings" / "panda_nominal_6s.mcap"
    done = subprocess.run(
        [sys.executable, script, log], cwd=tmp_path, capture_output=True, text=True, timeout=550
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    assert said == {
        "run": 9,  # half a second teaches no θ
        "log": ["adapter.drivers.files.mcap.log", True],
        "sample": "adapter.drivers.interface",
        "mine": ["green", 3, 24],
    }
    assert (tmp_path / "out" / "recording.mcap").exists()


def test_a_command_given_beside_them_works(tmp_path: Path) -> None:
    """`python -m` puts the folder first, too."""
    for name in ("drivers", "sim"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('not ours')\n")
    log = ROOT / "recordings" / "panda_nominal_6s.mcap"
    for words in (["info", str(log)], ["sim", "fci", "--help"], ["sim", "can", "--help"]):
        done = subprocess.run(
            [sys.executable, "-m", "adapter", *words], cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr


def test_where_nobody_has_the_names_they_are_what_they_are() -> None:
    assert own_name("drivers.interface") == "drivers.interface"
    assert adapter.Log.__module__ == "drivers.files.mcap.log"
