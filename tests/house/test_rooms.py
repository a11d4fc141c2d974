"""The rooms and who may import whom, lazy imports and TYPE_CHECKING included."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

from adapter.cli.completion import NAMES_OF
from adapter.cli.main import COMMANDS
from adapter.cli.options import NAMES
from adapter.cli.run import SIMULATED_BY
from adapter.cli.sim import ARMS
from adapter.experiments.arguments import SPLIT
from drivers.registry import HARDWARE, LOG

ROOT = Path(__file__).parents[2]
PACKAGES = ("adapter", "drivers", "sim")
MOST_ARGUMENTS = 6  # more are a record
LOOSE = {"__init__.py", "__main__.py", "errors.py", "optional.py", "shadowed.py", "py.typed"}
# What takes long to load, or is not there everywhere: the only thing a function may import.
HEAVY = {
    *("torch", "numba", "pybullet", "matplotlib", "scipy", "filterpy", "clarabel", "sklearn"),
    *("pinocchio", "coal", "mujoco", "can", "figaroh", "cma"),
    *("rich", "importlib.metadata", "foxglove", "cyclonedds", "jinja2"),
}
FACES = {
    "adapter",
    "adapter.gap",
    "drivers.registry",
}  # for type checkers alone; `__getattr__` finds the same


@cache
def graph() -> grimp.ImportGraph:
    """Every import, wherever it stands in a file, and the commands that are loaded by name."""
    whole = grimp.build_graph(*PACKAGES, cache_dir=None)
    run_by = [c.run_by or f"adapter.cli.{name}" for name, c in COMMANDS.items()]
    by_name = {"adapter.cli.main": [name.partition(":")[0] for name in run_by]}
    by_name["adapter.cli.sim"] = [m for s in ARMS.values() for m in (s.options, s.command)]
    by_name["adapter.cli.options"] = [NAMES]
    by_name["adapter.experiments.arguments"] = [SPLIT]
    by_name["adapter.cli.completion"] = [module for module, _ in NAMES_OF.values()]
    by_name["adapter.cli.run"] = [SIMULATED_BY]
    by_name["drivers.registry"] = [
        f"drivers{target.partition(':')[0]}" for target in (LOG, *HARDWARE.values())
    ]
    for importer, imported in by_name.items():
        for module in imported:
            assert module in whole.modules, f"{importer} names {module}, which is not there"
            whole.add_import(importer=importer, imported=module)
    return whole


def sources() -> Iterator[tuple[str, ast.Module]]:
    """(module, syntax tree) of every file."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            yield module.removesuffix(".__init__"), ast.parse(path.read_text(), str(path))


def test_nothing_is_loose_in_the_root() -> None:
    files = {path.name for path in (ROOT / "adapter").iterdir() if path.is_file()}
    assert files == LOOSE


def test_every_room_is_a_layer() -> None:
    rooms = {path.parent.name for path in (ROOT / "adapter").glob("*/__init__.py")}
    folders = {p.name for p in (ROOT / "adapter").iterdir() if p.is_dir() and any(p.glob("*.py"))}
    assert rooms == folders
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    contract = next(c for c in table["contracts"] if c["type"] == "layers")
    layers = [name.strip() for layer in contract["layers"] for name in layer.split("|")]
    assert sorted(layers) == sorted(
        f"adapter.{room}" for room in (*rooms, "errors", "optional", "shadowed")
    )
    assert not contract.get("ignore_imports") and not contract.get("containers")


def need_no_circle(arrows: dict) -> None:
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as circle:
        pytest.fail(" <- ".join(circle.args[1]))


def test_no_circle_between_modules() -> None:
    whole = graph()
    arrows = {
        module: [
            other
            for other in whole.find_modules_directly_imported_by(module)
            if not other.startswith(f"{module}.")  # a package gathers what is in it
        ]
        for module in whole.modules
    }
    need_no_circle(arrows)


def test_no_circle_between_rooms() -> None:
    whole, arrows = graph(), {}
    for module in whole.modules:
        room = ".".join(module.split(".")[:2])
        others = {
            ".".join(other.split(".")[:2])
            for other in whole.find_modules_directly_imported_by(module)
        }
        arrows.setdefault(room, set()).update(others - {room})
    arrows.pop("adapter")  # the face stands above all rooms
    need_no_circle(arrows)


def test_the_experiments_are_known_to_the_command_alone() -> None:
    whole = graph()
    inside = {m for m in whole.modules if m.startswith("adapter.experiments")}
    importers = {m for inner in inside for m in whole.find_modules_that_directly_import(inner)}
    assert importers - inside <= {"adapter.cli.main"}


def test_functions_import_heavy_libraries_alone() -> None:
    found = []
    for module, tree in sources():
        top = set(map(id, tree.body))
        for node in ast.walk(tree):
            if id(node) in top or not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [("." * node.level) + (node.module or "")]
            )
            lazy = [name for name in names if not {name, name.split(".")[0]} & HEAVY]
            if lazy and module not in FACES:
                found.append(f"{module}:{node.lineno} imports {', '.join(lazy)}")
    assert not found, "\n".join(found)


def test_no_function_takes_more_than_six_arguments() -> None:
    found = []
    for module, tree in sources():
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            names = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            own = [name.arg for name in names if name.arg not in ("self", "cls")]
            if len(own) > MOST_ARGUMENTS:
                found.append(f"{module}:{node.lineno} {node.name}({', '.join(own)})")
    assert not found, "\n".join(found)
