"""A user's own `drivers.py` or `sim.py` beside a script does not take the place of ours.

The packages `drivers` and `sim` lie beside `adapter` under names that others use, too, and Python
gives a script's own folder precedence. Where another module has such a name, ours are loaded as
`adapter.drivers` and `adapter.sim`, from the same files: import statements in our own files then
mean these, and everybody else's mean what they always did. Where nobody else has the names,
nothing here does anything.
"""

from __future__ import annotations

import builtins
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

BESIDE = ("drivers", "sim")
_HOME = Path(__file__).resolve().parents[1]
_INSIDE = "adapter"


def own_name(module: str) -> str:
    """The name under which a module of `drivers` or `sim` is loaded, for imports by name."""
    return f"{_INSIDE}.{module}" if _active() and module.split(".")[0] in BESIDE else module


def keep_apart() -> None:
    """Where others have the names of our packages, load ours under names inside `adapter`."""
    if not _active() and not all(map(_is_ours, BESIDE)):
        sys.meta_path.insert(0, _Finder())


def _active() -> bool:
    return any(isinstance(finder, _Finder) for finder in sys.meta_path)


def _is_ours(package: str) -> bool:
    """Whether this name means ours, here and now."""
    loaded = sys.modules.get(package)
    spec = find_spec(package) if loaded is None else getattr(loaded, "__spec__", None)
    if spec is None or spec.origin is None:
        return False
    return Path(spec.origin).resolve() == _HOME / package / "__init__.py"


class _Finder:
    """Finds what is inside `adapter`, and `drivers` and `sim` as if they were."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's specification; None for what is not ours."""
        outer, _, last = name.rpartition(".")
        if not name.startswith(f"{_INSIDE}."):
            return None
        beside = outer == _INSIDE and last in BESIDE
        spec = PathFinder.find_spec(name, [str(_HOME)] if beside else path, target)
        if spec is not None and type(spec.loader) is SourceFileLoader:
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    """Runs a file whose import statements mean our own packages."""

    def exec_module(self, module: ModuleType) -> None:
        """Python takes `__import__` from the names that a module has built in."""
        vars(module)["__builtins__"] = {**vars(builtins), "__import__": _import}
        super().exec_module(module)


def _import(
    name: str,
    globals: Mapping[str, object] | None = None,
    locals: Mapping[str, object] | None = None,
    fromlist: Sequence[str] | None = (),
    level: int = 0,
) -> ModuleType:
    """What an import statement calls."""
    first = name.split(".")[0]
    if level or first not in BESIDE:
        return builtins.__import__(name, globals, locals, fromlist or (), level)
    module = import_module(f"{_INSIDE}.{name}")
    if not fromlist:  # `import drivers.interface` gives the name `drivers`
        return sys.modules[f"{_INSIDE}.{first}"]
    return builtins.__import__(module.__name__, globals, locals, fromlist, 0)
