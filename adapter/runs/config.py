"""Settings from TOML, with every key checked, and back into a recording."""

from __future__ import annotations

import dataclasses
import tomllib
import types
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from adapter.control.settings import Cell, ExcitationSettings, SafetySettings
from adapter.errors import SettingsError
from adapter.learning.settings import LearnerSettings
from adapter.model.self_model import SelfModel, Tool
from adapter.signals.settings import FilterSettings, FrontEndSettings
from drivers.errors import choices
from drivers.files.bounded import read_text


@dataclass(frozen=True)
class ToolSettings:
    """A known tool: mass in kg, centre (m) and inertia about it (kg m²) in the last link's frame.

    `inertia` is XX XY XZ YY YZ ZZ.
    """

    mass: float
    com: tuple[float, ...] = (0.0, 0.0, 0.0)
    inertia: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.mass > 0.0 or len(self.com) != 3 or len(self.inertia) != 6:
            raise SettingsError("tool needs mass > 0, com of 3 and inertia of 6 numbers")

    def tool(self) -> Tool:
        """As part of a model."""
        xx, xy, xz, yy, yz, zz = self.inertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return Tool(self.mass, np.array(self.com), tensor)


@dataclass(frozen=True)
class PipelineSettings:
    """Settings of the parts."""

    filter: FilterSettings = field(default_factory=FilterSettings)
    front_end: FrontEndSettings = field(default_factory=FrontEndSettings)
    learner: LearnerSettings = field(default_factory=LearnerSettings)


@dataclass(frozen=True)
class Config:
    """Everything that can be set.

    Attributes:
        gravity: (3,) acceleration of gravity in base axes, m/s²; a wall- or ceiling-mounted arm
            differs from the default [0, 0, -9.81]. None: that of the robot's model.
        tool: a known tool, kept out of θ.
        pipeline: filter, front end, learner.
        excitation: of the controller in `run`.
        safety: when it stops the arm because that does not move as it should.
        cell: what an arm that may be real must not touch in `run`.
    """

    gravity: tuple[float, ...] | None = None
    tool: ToolSettings | None = None
    pipeline: PipelineSettings = field(default_factory=PipelineSettings)
    excitation: ExcitationSettings = field(default_factory=ExcitationSettings)
    safety: SafetySettings = field(default_factory=SafetySettings)
    cell: Cell = field(default_factory=Cell)

    def __post_init__(self) -> None:
        if self.gravity is not None and len(self.gravity) != 3:
            raise SettingsError(f"gravity needs 3 numbers, got {len(self.gravity)}")

    def apply(self, documented: SelfModel) -> SelfModel:
        """The documented model with this gravity and tool."""
        changes: dict[str, Any] = {}
        if self.gravity is not None:
            changes["gravity"] = np.array(self.gravity, dtype=float)
        if self.tool is not None:
            changes["tool"] = self.tool.tool()
        return dataclasses.replace(documented, **changes)


def with_imus(pipeline: PipelineSettings, links: tuple[str, ...]) -> PipelineSettings:
    """The same settings with sensors glued on these links, and no others."""
    schema = dataclasses.replace(pipeline.learner.schema, imus=links)
    learner = dataclasses.replace(pipeline.learner, schema=schema)
    return dataclasses.replace(pipeline, learner=learner)


def read_config(path: str | Path | None) -> Config:
    """Settings from a TOML file; the defaults without one. Raises SettingsError."""
    if path is None:
        return Config()
    try:
        table = tomllib.loads(read_text(path))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"{path}: not TOML: {error}") from error
    config = config_from(table, str(path))
    return dataclasses.replace(config, cell=config.cell.beside(Path(path).resolve().parent))


def config_from(table: dict[str, Any], where: str = "configuration") -> Config:
    """Settings from nested tables. Raises SettingsError naming the key and the choices."""
    return _build(Config, table, where)


def config_recorded(table: dict[str, Any], where: str) -> tuple[Config, list[str]]:
    """Settings that a recording was made with, and those in it that this version has not.

    Raises SettingsError for a value that is none.
    """
    unknown: list[str] = []
    return config_from(_known(Config, table, unknown), where), unknown


def _known(kind: Any, table: Any, unknown: list[str], before: str = "") -> Any:
    """A table without the keys that are no settings; those go to `unknown`."""
    if not isinstance(table, dict) or not dataclasses.is_dataclass(kind):
        return table
    hints = get_type_hints(kind)
    unknown += [before + key for key in table if key not in hints]
    known = [key for key in table if key in hints]
    return {key: _known(hints[key], table[key], unknown, f"{before}{key}.") for key in known}


def config_table(config: Config) -> dict[str, Any]:
    """The settings as nested tables (JSON and TOML values; unset ones left out)."""
    return _drop_none(dataclasses.asdict(config))


def _drop_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _drop_none(part) for key, part in value.items() if part is not None}
    return [_drop_none(part) for part in value] if isinstance(value, tuple) else value


def _build(kind: Any, table: Any, where: str) -> Any:
    if not isinstance(table, dict):
        raise SettingsError(f"{where}: needs a table, got {table!r}")
    hints = get_type_hints(kind)
    known = [f.name for f in dataclasses.fields(kind)]
    for key in table:
        if key not in known:
            raise SettingsError(f"{where}: no setting '{key}'; {choices(key, known)}")
    values = {key: _value(hints[key], part, f"{where}: {key}") for key, part in table.items()}
    try:
        return kind(**values)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error
    except TypeError as error:
        raise SettingsError(f"{where}: {str(error).partition(') ')[2] or error}") from error


def _value(hint: Any, value: Any, where: str) -> Any:
    if get_origin(hint) in (Union, types.UnionType):
        hint = next(part for part in get_args(hint) if part is not type(None))
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, where)
    if get_origin(hint) is tuple:
        if not isinstance(value, list):
            raise SettingsError(f"{where} needs a list, got {value!r}")
        return tuple(_value(get_args(hint)[0], part, where) for part in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
        raise SettingsError(f"{where} needs {hint.__name__}, got {value!r}")
    return value
