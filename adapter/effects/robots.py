"""Robots with what their joints have beside the rigid arm: by name or file, and back into files.

Each effect writes itself. A file's reader gets friction, the load and the inertias, the zero of
the encoders and the tilt of the base under its own, upright gravity, so that the rigid arm in it
takes the torque of the model's; what has no place in a format is said in words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from adapter.effects.active import Active, active_effects, check_effects
from adapter.effects.catalogue import CATALOGUE
from adapter.model.mjcf import mjcf_onto, read_mjcf
from adapter.model.mjcf_text import MJCF_PLACES, mjcf_text
from adapter.model.robots import documented
from adapter.model.self_model import MJCF, SelfModel, theta_doubt
from adapter.model.urdf import file_text, urdf_onto
from adapter.model.urdf_text import STIFFNESS, URDF_PLACES, Additions, unplaced, urdf_text
from adapter.model.xml_edit import XmlText


def read_robot(
    name: str | Path,
    joints: Sequence[str] | None = None,
    floating: bool = False,
    gravity: ArrayLike | None = None,
    lock: Mapping[str, float] | None = None,
) -> SelfModel:
    """As `model.robots.documented`, and MJCF (.xml), whose joints bring their effects.

    Raises:
        ModelError: as there; effects that are not in the catalogue.
    """
    if Path(name).suffix.lower() != ".xml":
        return check_effects(documented(name, joints, floating, gravity, lock), name)
    model, extras = read_mjcf(name, joints, floating, gravity, lock)
    return check_effects(replace(model, effects=_effects(extras)), name)


def _effects(joints: Sequence[dict[str, float]]) -> tuple[dict[str, Any], ...]:
    """Entries of a model file for what MuJoCo's joints have."""
    found = []
    for effect in CATALOGUE.values():
        key = MJCF_PLACES.get(effect.place, "")
        having = [j for j, joint in enumerate(joints) if key in joint]
        if having:
            pairs = zip(effect.parameters, (key, "springref"), strict=False)
            values = {p.key: [joints[j].get(k, 0.0) for j in having] for p, k in pairs}
            numbers = [j + 1 for j in having]
            found.append({"effect": effect.name, "joints": numbers, "parameters": values})
    return tuple(found)


@dataclass(frozen=True)
class RobotText:
    """A robot's file with a learned model in it.

    Attributes:
        text: of the file.
        onto: the file it was written onto, None where the arm stands alone.
        left_out: names of the effects that the format has no place for, or not for all of them.
        notes: what a user should know of it, in words.
    """

    text: str
    onto: str | None
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def robot_urdf(model: SelfModel, onto: str | Path | None = None, alone: bool = False) -> RobotText:
    """URDF of a model with its effects: written onto the robot's file, or the arm alone.

    Args:
        model: with its effects.
        onto: a URDF; where None, the one that the model came from, if it did.
        alone: the arm alone, whatever it came from.

    Raises:
        ModelError: a URDF that is not the model's, or where a body is physically impossible.
    """
    more, source = additions(model, URDF_PLACES), model.source
    left_out = tuple(more.names)
    if onto is not None:
        text, file = file_text(onto), str(onto)
    elif source is not None and source.text is not None and not alone:
        text, file = source.text, source.file
    else:
        return _doubted(model, RobotText(urdf_text(model, more), None, left_out, ()))
    written, notes = urdf_onto(model, more, text, file)
    lacking = _lacking("a URDF", unplaced(model, more))
    return _doubted(model, RobotText(written, file, left_out, (*notes, *lacking)))


def to_urdf(model: SelfModel) -> str:
    """URDF text of the arm alone with its effects, as far as a URDF goes (see `model.urdf_text`).

    Raises:
        ModelError: where a body is physically impossible; names the link and the eigenvalue.
    """
    return urdf_text(model, additions(model, URDF_PLACES))


def robot_mjcf(model: SelfModel, onto: str | Path | None = None, alone: bool = False) -> RobotText:
    """MJCF of a model with its effects, as `robot_urdf`.

    Raises:
        ModelError: as there, and where MuJoCo, which reads an MJCF, is not installed.
    """
    more, source = additions(model, tuple(MJCF_PLACES)), model.source
    left_out, notes = tuple(more.names), list[str]()
    if onto is None and source is not None and source.format == MJCF and not alone:
        onto = source.file
        if not Path(onto).exists():
            notes = [f"{onto}, which the model came from, is not there; this is the arm alone"]
            onto = None
    if onto is None:
        return _doubted(model, RobotText(mjcf_text(model, more), None, left_out, tuple(notes)))
    written, notes = mjcf_onto(model, more, onto)
    notes += _lacking("an MJCF", more.left_out)
    return _doubted(model, RobotText(written, str(onto), left_out, tuple(notes)))


def _doubted(model: SelfModel, written: RobotText) -> RobotText:
    """The same with what is to be said of the model's θ, as a comment in the file and a note."""
    if not theta_doubt(model):
        return written
    xml, doubt = XmlText(written.text, model.name), f"θ: {theta_doubt(model)}"
    xml.remark(doubt)
    return replace(written, text=xml.text(), notes=(*written.notes, doubt))


def _lacking(kind: str, left_out: Sequence[str]) -> list[str]:
    """What a format has no place for, in one sentence."""
    return [f"{kind} has no place for {'; '.join(left_out)}"] if left_out else []


def additions(model: SelfModel, places: Sequence[str]) -> Additions:
    """What the model's effects add to a file whose joints have these places.

    Numbers that are no more than noise are written where they have a place, and not missed where
    they have none.
    """
    acting = active_effects(model.effects, model.tree.n)
    more = _additions(model, places, acting)
    shown = _additions(model, places, [active for active in acting if active.shown])
    more.left_out, more.names = shown.left_out, shown.names
    return more


def _additions(model: SelfModel, places: Sequence[str], acting: Sequence[Active]) -> Additions:
    more, names = Additions(model.tree.n, model.tree.floating, tuple(places)), set()
    for active in acting:
        note = "it ended"
        if active.lasting:
            part = active.effect.export(more, active.joint, active.values)
            if part is None or not any(map(np.any, active.values.values())):
                continue
            note = part
        slides = active.joint >= 0 and model.tree.slides[active.joint]
        name, units = active.effect.name, active.effect.units(slides)
        where = "" if active.joint < 0 else f" of {model.tree.joint_names[active.joint]}"
        numbers = [f"{key} = {_number(x)} {units[key]}" for key, x in active.values.items()]
        said = f"{name}{where}, {', '.join(numbers)}"
        more.left_out.append(said + (f" ({note})" if note else ""))
        names.add(name)
    for what, table in more.joint.items():  # no format takes negative losses
        for j in np.flatnonzero(table < 0.0) if what != STIFFNESS else ():
            name = model.tree.joint_names[j]
            more.left_out.append(f"{what} of {name}, which is negative: {table[j]:g}")
            table[j] = 0.0
    more.names = sorted(names)
    return more


def _number(value: object) -> str:
    if isinstance(value, int | float):
        return f"{value:.4g}"
    return str([float(f"{x:.4g}") for x in np.ravel(np.asarray(value, float))])
