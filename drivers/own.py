"""A driver of the user's own, from a file: `my_arm.py:MyArm?host=10.0.0.2`."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from urllib.parse import parse_qsl

from drivers.errors import DriverError, choices
from drivers.interface import Driver

ASKED = tuple(name for name in vars(Driver) if not name.startswith("_"))


def open_own(address: str, joint_names: Sequence[str] | None, allow_motion: bool) -> Driver:
    """The driver that FILE.py:CLASS names, not connected yet.

    What follows a `?` goes to the class by name, as text. It is also given `joint_names` and
    `allow_motion` where it takes them.

    Args:
        address: FILE.py:CLASS, or FILE.py:CLASS?KEY=VALUE&...
        joint_names: of the robot that is learned, in its order.
        allow_motion: whether the arm may be moved.

    Raises:
        DriverError: no such file or class; it takes other arguments, lacks part of
            `drivers.interface.Driver`, has other joints, or would move without permission.
    """
    file, _, rest = address.partition(":")
    name, _, query = rest.partition("?")
    found = vars(_loaded(Path(file)))
    classes = [key for key, x in found.items() if inspect.isclass(x) and hasattr(x, "read")]
    if name not in classes:
        raise DriverError(f"{file}: no driver '{name}'; {choices(name, classes)}")
    made: type[Driver] = found[name]
    given: dict[str, object] = dict(parse_qsl(query, keep_blank_values=True))
    names = None if joint_names is None else tuple(joint_names)
    for key, value in (("joint_names", names), ("allow_motion", allow_motion)):
        if key in inspect.signature(made).parameters:
            given[key] = value
    try:
        arm = made(**given)
    except TypeError as error:
        raise DriverError(f"{address}: {name} cannot be made of {given}: {error}") from error
    missing = [part for part in ASKED if not hasattr(arm, part)]
    if missing:
        raise DriverError(f"{address}: {name} lacks {', '.join(missing)}; see drivers/interface.py")
    if names is not None and tuple(arm.joint_names) != names:
        raise DriverError(
            f"{address}: its joints are {', '.join(arm.joint_names)}, the robot's "
            f"{', '.join(names)}; name a --robot with its joints, or take joint_names"
        )
    if arm.can_move and not allow_motion:
        raise DriverError(
            f"{address}: can_move is true though nobody allowed motion; take allow_motion in "
            "__init__ and let can_move say it"
        )
    return arm


def _loaded(file: Path) -> ModuleType:
    """The file as a module; what lies beside it can be imported by it."""
    spec = spec_from_file_location(f"own_driver_{file.stem}", file)
    if not file.is_file() or spec is None or spec.loader is None:
        raise DriverError(f"{file}: no such file")
    module = module_from_spec(spec)
    beside = str(file.resolve().parent)
    if beside not in sys.path:
        sys.path.append(beside)  # at the end: a user's sim.py hides nothing
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
