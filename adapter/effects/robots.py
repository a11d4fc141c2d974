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
from adapter.effects.catalogue import CATALOGUE, KNOWN
from adapter.effects.law import LAWS
from adapter.model.filled import MJCF_PLACES, PLACES, filled
from adapter.model.mjcf import mjcf_onto, read_mjcf
from adapter.model.robots import documented
from adapter.model.self_model import MJCF, SelfModel, gravity_down, theta_doubt
from adapter.model.tree import Tree
from adapter.model.urdf import file_text, urdf_onto
from adapter.model.urdf_text import CUBIC_DRAG, DRAG, NO_PLACE, STIFFNESS, Additions, Kept
from adapter.model.usd import usd_onto
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
    for effect in (*CATALOGUE.values(), *LAWS.values()):
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
        kept: how much of which effect is in it.
        notes: what a user should know of it, in words.
    """

    text: str
    onto: str | None
    kept: tuple[Kept, ...]
    notes: tuple[str, ...]

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the effects that the format has no place for, or not for all of them."""
        return tuple(sorted({x.effect for x in self.kept if x.part is not None}))

    @property
    def lacks(self) -> str:
        """The same in one sentence; nothing where all is in it."""
        rows = {x.effect: KNOWN[x.effect].title for x in self.kept}
        gone = {x.effect for x in self.kept if x.part == NO_PLACE}
        partly = [rows[name] for name in self.left_out if name not in gone]
        said = [f"drops {', '.join(rows[name] for name in sorted(gone))}"] * bool(gone)
        said += [f"holds in part {', '.join(partly)}"] * bool(partly)
        more = " (numbers: its first lines; formats: docs/simulate-what-was-learned.md)"
        return "; ".join(said) + more * bool(said)


def kept_lines(kept: Sequence[Kept]) -> list[str]:
    """A line for each effect and how much of it a file holds, with its numbers where not all."""
    found = dict[tuple[str, str | None], list[str]]()
    for one in kept:
        found.setdefault((one.effect, one.part), []).append(one.of)
    lines = []
    for (name, part), own in found.items():
        how = "whole" if part is None else part or "no"
        lines += [f"{KNOWN[name].title}: {how}", *(f"  {x}" for x in own if part is not None)]
    return lines


def robot_urdf(model: SelfModel, onto: str | Path | None = None, alone: bool = False) -> RobotText:
    """URDF of a model with its effects: written onto the robot's file, or the arm alone.

    Args:
        model: with its effects.
        onto: a URDF; where None, the one that the model came from, if it did.
        alone: the arm alone, whatever it came from.

    Raises:
        ModelError: a URDF that is not the model's, or where a body is physically impossible.
    """
    more, source = additions(model, PLACES["urdf"]), model.source
    if onto is not None:
        text, file = file_text(onto), str(onto)
    elif source is not None and source.text is not None and not alone:
        text, file = source.text, source.file
    else:
        return _with_head(model, more, "urdf", filled("urdf", model, more))
    return _with_head(model, more, "urdf", *urdf_onto(model, more, text, file), file)


def robot_mjcf(model: SelfModel, onto: str | Path | None = None, alone: bool = False) -> RobotText:
    """MJCF of a model with its effects, as `robot_urdf`.

    Raises:
        ModelError: as there, and where MuJoCo, which reads an MJCF, is not installed.
    """
    more, source, notes = additions(model, PLACES["mjcf"]), model.source, list[str]()
    if onto is None and source is not None and source.format == MJCF and not alone:
        onto = source.file
        if not Path(onto).exists():
            notes = [f"{onto}, which the model came from, is not there; this is the arm alone"]
            onto = None
    if more.joint[DRAG].any() or more.joint[CUBIC_DRAG].any():
        notes.append("damping with a polynomial, which MuJoCo reads from version 4 on")
    if onto is None:
        return _with_head(model, more, "mjcf", filled("mjcf", model, more), notes)
    text, said = mjcf_onto(model, more, onto)
    return _with_head(model, more, "mjcf", text, [*notes, *said], str(onto))


def robot_text(
    kind: str, model: SelfModel, onto: str | Path | None = None, alone: bool = True
) -> RobotText:
    """SDF, USD or Isaac Lab's actuators of the arm alone with its effects.

    Args:
        kind: of `filled.PLACES`; onto: of USD, an asset that the text is a layer over.

    Raises:
        ModelError: as `robot_urdf`; MeansError: an asset, and usd-core is not installed.
    """
    more = additions(model, PLACES[kind])
    if onto is None:
        return _with_head(model, more, kind, filled(kind, model, more))
    return _with_head(model, more, kind, *usd_onto(model, more, onto), str(onto))


def _with_head(
    model: SelfModel,
    more: Additions,
    kind: str,
    text: str,
    notes: Sequence[str] = (),
    onto: str | None = None,
) -> RobotText:
    """The text with a comment first in it: how much of which effect it holds, and doubt of θ.

    None where it holds all: what is written onto a file then leaves it as it is but for numbers.
    """
    doubt, missing = theta_doubt(model), list(more.left_out)
    if kind != "mjcf" and not np.array_equal(model.gravity, gravity_down()):
        missing.append(f"gravity {model.gravity.tolist()} m/s2 in base axes")
    said = [f"no place for {x}" for x in missing] + [f"θ: {doubt}"] * bool(doubt)
    lines = [
        f"what this {kind.upper()} holds of the effects of {model.name}",
        *kept_lines(more.kept),
    ]
    if all(x.part is None for x in more.kept) and not said:
        lines = []
    lines += said
    if text.lstrip().startswith("<"):
        xml = XmlText(text, model.name)
        xml.remark(lines)
        text = xml.text()
    else:
        head = "\n".join("# " + " ".join(x.splitlines()) for x in lines or [model.name])
        text = text.replace("#@HEAD@", head, 1)
    return RobotText(text, onto, tuple(more.kept), (*notes, *said))


def additions(model: SelfModel, places: Sequence[str]) -> Additions:
    """What the model's effects add to a file whose joints have these places.

    Numbers that are no more than noise are written where they have a place, and not missed where
    they have none.
    """
    more, shown = Additions(model.tree.n, model.tree.floating, tuple(places)), set[int]()
    for active in active_effects(model.effects, model.tree.n):
        part: str | None = NO_PLACE
        if active.lasting:
            part = active.effect.export(more, active.joint, active.values)
            part = part if any(map(np.any, active.values.values())) else None
        if active.shown:
            shown.add(active.joint)
        if active.shown or part is None:
            more.kept.append(Kept(active.effect.name, in_words(active, model.tree), part))
    for what, table in more.joint.items():  # no format takes negative losses
        for j in np.flatnonzero(table < 0.0) if what != STIFFNESS else ():
            if j in shown:
                told = f"{what} of {model.tree.joint_names[j]}, which is negative: {table[j]:g}"
                more.left_out.append(told)
            table[j] = 0.0
    return more


def in_words(active: Active, tree: Tree) -> str:
    """The joint that an effect has, and its numbers."""
    units = active.effect.units(active.joint >= 0 and tree.slides[active.joint])
    where = "" if active.joint < 0 else f"{tree.joint_names[active.joint]}: "
    told = {key: np.vectorize("{:.4g}".format)(x).tolist() for key, x in active.values.items()}
    said = [f"{key} = {x} {units[key]}".replace("'", "") for key, x in told.items()]
    return where + ", ".join(said) + (" (it ended)" if not active.lasting else "")
