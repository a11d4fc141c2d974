"""`import adapter`: light, typed, with examples that run; and a command line that is light, too."""

from __future__ import annotations

import ast
import doctest
import inspect
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest

import adapter
from adapter.errors import ModelError
from adapter.model.model_file import dumps

ROOT = Path(__file__).parents[2]
HEAVY = {"torch", "numba", "pybullet", "matplotlib", "scipy", "clarabel", "sklearn", "filterpy"}
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def loaded(*words: str) -> tuple[int, set[str], str]:
    """Exit code, heavy packages that were loaded, and what was said, of a fresh interpreter."""
    code = (
        "import sys\n"
        f"sys.argv[1:] = {list(words)!r}\n"
        "code = 0\n"
        "if sys.argv[1:]:\n"
        "    from adapter.cli import main\n"
        "    try:\n"
        "        code = main()\n"
        "    except SystemExit as end:\n"
        "        code = end.code or 0\n"
        "else:\n"
        "    import adapter\n"
        "print('loaded', code, len(sys.modules), *sorted(n for n in sys.modules if '.' not in n))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1].split()
    return int(last[1]), HEAVY & set(last[3:]), done.stdout + done.stderr


def printed(code: str) -> str:
    """By a fresh interpreter."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_importing_the_package_loads_next_to_nothing() -> None:
    code = "import sys; a = set(sys.modules); import adapter; print(len(set(sys.modules) - a))"
    assert int(printed(code)) < 30
    assert loaded() == (0, set(), loaded()[2])


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--help"], 0, "COMMAND"),
        (["--version"], 0, "."),
        (["run", "--help"], 0, "--allow-motion"),
        (["nonsense"], 2, "no command"),
        (["run", "--nonsense"], 2, "--nonsense"),
        (["run", "--duration", "-1"], 2, "--duration"),
        (["run", "--driver", "pybullet:pnada"], 2, "panda"),
        (["run", "--driver", "serial:1"], 2, "pybullet"),
        (["run", "--config", "nowhere.toml"], 2, "nowhere.toml"),
        (["run", "--effects", "magic"], 2, "coulomb_friction"),
        (["run", "--set", 'levels={"q_above_50hzz": 0}'], 2, "q_above_50hz,"),
        (["run", "--scenario", "nowhere"], 2, "bent_link"),
        (["run", "--set", "mass=1"], 2, "noise, links, levels"),
        (["run", "--fault", "magic=1"], 2, "clock"),
        (["sim", "fci", "--help"], 0, "--protocol"),
        (["sim", "fci", "--fault", "magic"], 2, "reorder"),
        (["sim", "can", "--help"], 0, "--motors"),
        (["sim", "can", "--fault", "magic"], 2, "bus_off"),
        (["replay", "nowhere.mcap"], 2, "nowhere.mcap"),
        (["replay", "README.md", "--every", "5", "--mode", "sample"], 2, "--every"),
        (["gap", "nowhere.mcap", "--robot", "panda"], 2, "nowhere.mcap"),
        (["gap", "README.md", "--robot", "pnada"], 2, "panda"),
        (["discover", "nowhere.mcap"], 2, "nowhere.mcap"),
        (["info", "nowhere.mcap"], 2, "nowhere.mcap"),
        (["import", "nowhere.csv", "--to", "x.mcap"], 2, "nowhere.csv"),
        (["export", "nowhere.json", "--urdf", "x.urdf"], 2, "nowhere.json"),
        (["report", "nowhere"], 2, "nowhere"),
        (["experiment", "mars"], 2, "atlas"),
    ],
)
def test_help_and_wrong_use_load_nothing_heavy(words: list[str], code: int, said: str) -> None:
    found, heavy, text = loaded(*words)
    assert (found, heavy) == (code, set()) and said in text
    assert text.count("error: ") == (code == 2) and "Traceback" not in text


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ("gravty = [0.0]", "gravity"),
        ("[pipeline.filter]\nbandwidth_hz = 0", "bandwidth_hz"),
        ('[pipeline.learner]\neffects = ["magic"]', "coulomb_friction"),
        ('[pipeline.learner]\nmode = "magic"', "moments"),
    ],
)
def test_wrong_settings_load_nothing_heavy(tmp_path: Path, toml: str, said: str) -> None:
    path = tmp_path / "my.toml"
    path.write_text(toml)
    found, heavy, text = loaded("run", "--config", str(path))
    assert (found, heavy) == (2, set()) and said in text


def test_what_takes_seconds_to_load_is_loaded_where_it_is_used() -> None:
    code = (
        "import sys, adapter.cli.run, adapter.cli.replay, adapter.cli.gap\n"
        "before = any(name in sys.modules for name in ('matplotlib', 'torch'))\n"
        "adapter.report.style.Drawing('half').panel('a')\n"
        "print(before, 'matplotlib' in sys.modules)"
    )
    assert printed(code).split() == ["False", "True"]


def test_a_model_whose_effects_do_not_exist_is_refused(tmp_path: Path) -> None:
    panda = adapter.load_model("panda")
    entry = {"effect": "magic", "joints": [1], "parameters": {}}
    path = tmp_path / "magic.json"
    path.write_text(dumps(replace(panda, effects=(entry,))))
    with pytest.raises(ModelError, match=r"magic\.json: no effect 'magic'; have: "):
        adapter.load_model(path)


def test_the_face_is_the_same_to_type_checkers_and_at_run_time() -> None:
    tree = ast.parse((ROOT / "adapter" / "__init__.py").read_text())
    typed = {
        alias.name: node.module
        for block in tree.body
        if isinstance(block, ast.If)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert typed == adapter._FROM and sorted(typed) == sorted(adapter.__all__)
    assert (ROOT / "adapter" / "py.typed").exists()
    for name, module in typed.items():
        assert getattr(adapter, name) is getattr(import_module(module), name)
    with pytest.raises(AttributeError, match="nonsense"):
        adapter.nonsense  # noqa: B018


@pytest.mark.parametrize("name", sorted(adapter.__all__))
def test_every_name_is_explained(name: str) -> None:
    thing = getattr(adapter, name)
    assert inspect.getdoc(thing)
    if not inspect.isfunction(thing):
        return
    hints = inspect.get_annotations(thing)
    assert set(hints) == {*inspect.signature(thing).parameters, "return"}
    told = inspect.getdoc(thing) or ""
    for part in inspect.signature(thing).parameters:
        assert part in told, f"{name} does not explain {part}"


@pytest.mark.parametrize(
    "name",
    [n for n in sorted(adapter.__all__) if n[0].islower() or n in ("Learner", "SnapshotReader")],
)
def test_every_example_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    found = doctest.DocTestFinder(recurse=False).find(getattr(adapter, name), name)
    assert sum(len(test.examples) for test in found) >= 2
    for test in found:
        assert doctest.DocTestRunner(optionflags=OPTIONS).run(test).failed == 0
