"""Every command, given what cannot be: one sentence, exit code 2, and no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from adapter.cli.main import COMMANDS, build_parser

RECORDING = Path(__file__).parents[2] / "recordings" / "panda_nominal_6s.mcap"
FILES = {  # the words after a command, FILE being what cannot be used
    "run": ["--driver", "log:FILE", "--duration", "1"],
    "plan": ["--motion", "FILE"],
    "excite": ["FILE"],
    "replay": ["FILE"],
    "gap": ["FILE", "--robot", "panda"],
    "fleet": [str(RECORDING), "--robot", "FILE"],
    "load": ["FILE"],
    "diff": ["FILE"],
    "discover": ["FILE"],
    "effects": ["keep", "FILE", "--as", "hose"],
    "import": ["FILE", "--to", "new.mcap"],
    "export": ["FILE", "--urdf", "new.urdf"],
    "report": ["FILE"],
    "recover": ["FILE"],
    "info": ["FILE"],
    "bench": ["--log", "FILE"],
}
WITHOUT = {"sim", "experiment", "completion"}  # take no file as such
EMPTY = ("empty.mcap", "empty.json", "empty.urdf", "empty.csv")
USELESS = ("gone.mcap", "folder", "noise.mcap", *EMPTY)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of useless files, which is where the user is."""
    for name in USELESS[2:]:
        (tmp_path / name).write_bytes(bytes(range(256)) * 8 if name.startswith("noise") else b"")
    (tmp_path / "folder").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_a_useless_file_is_refused_by_its_name(command: str, here: Path, refused) -> None:
    assert set(COMMANDS) == {*FILES, *WITHOUT}
    for name in USELESS if command in FILES else ():
        said = refused(command, *(w.replace("FILE", name) for w in FILES[command]))
        assert name in said, said
    assert not list(here.glob("new.*"))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_wrong_option_is_told_with_the_likeliest(command: str, here: Path, refused) -> None:
    words = [word.replace("FILE", "gone") for word in FILES.get(command, [])]
    words = {"sim": ["fci"], "experiment": ["panda"], "completion": ["bash"]}.get(command, words)
    assert "has no option '--nonsense'" in refused(command, *words, "--nonsense")
    (found,) = (a for a in build_parser()._actions if a.dest == "command")
    parser = found.choices[command]
    options = [o for a in parser._actions for o in a.option_strings if len(o) > 6]
    for option in (o for o in options if o != "--help"):
        wrong = option[:-2] + option[-1] + option[-2]
        if wrong not in options and wrong != option:
            assert "did you mean --" in refused(command, *words, f"{wrong}=1")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("replya x", "did you mean replay?"),
        ("run --duration soon", "--duration: takes a number, got 'soon'"),
        ("run --seed 1.5", "--seed: takes a whole number, got '1.5'"),
        ("run --duration", "--duration"),
        ("run --mode moment", "have: moments, sample; did you mean moments?"),
        ("run --robot pnada", "did you mean panda?"),
        ("run --robot arm.urdf.xacro", "xacro arm.urdf.xacro > arm.urdf"),
        ("run --effects coulom_friction", "did you mean coulomb_friction?"),
        ("run --scenario freiction", "did you mean friction?"),
        ("run --set lniks=true", "did you mean links?"),
        ("run --driver pybulet:panda", "did you mean pybullet?"),
        ("run --fault lsot=0.1", "did you mean lost?"),
        ("replay LOG --joints panda_jiont1", "did you mean panda_joint1?"),
        ("replay LOG --topic /joint_sates", "did you mean /joint_states?"),
        ("sim can --motors opnarm", "have: "),
        ("completion bsh", "did you mean bash?"),
    ],
)
def test_what_is_misspelt_is_guessed(line: str, said: str, here: Path, refused) -> None:
    words = (str(RECORDING) if word == "LOG" else word for word in line.split())
    assert said in refused(*words)


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("adapter rep", {"replay", "report"}),
        ("adapter run --robot pa", {"panda"}),
        ("adapter run --scenario pay", {"payload_at_20s"}),
        ("adapter gap --effec", {"--effects"}),
        ("adapter completion ", {"bash", "zsh", "fish"}),
        ("adapter run --effects coul", {"coulomb_friction"}),
    ],
)
def test_shells_are_offered_what_there_is(line: str, offered: set[str], tmp_path: Path) -> None:
    """As the code of `adapter completion bash` asks."""
    answer = tmp_path / "answer"
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_SUPPRESS_SPACE": "1"}
    asked |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
    asked |= {"_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
    code = "import sys; sys.argv = ['adapter']; from adapter.cli import main; main()"
    where = {"PYTHONPATH": str(Path(__file__).parents[2])}
    subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **where, **asked},
        cwd=tmp_path,
        timeout=100,
    )
    assert {word.strip() for word in answer.read_text().splitlines()} == offered
