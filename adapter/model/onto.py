"""What of a robot's file changes when a learned model is written onto it.

Places of joints, bodies and what joints have; a format's own module writes them. Links that move
together came into the model as one body: its link takes what was learned, the others keep theirs,
so that together they are what was learned.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import numpy as np

from adapter.errors import ModelError, ModelWarning
from adapter.model.inertia import (
    CONSISTENCY_TOLERANCE,
    is_consistent,
    move_theta,
    pseudo_inertia,
    theta_from_body,
)
from adapter.model.locking import LOCKED
from adapter.model.robot_file import FileRobot, Merged
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array, at_joints, matrix_from_zxz, rotation_angle
from adapter.model.tree import BASE
from adapter.model.urdf_text import Additions, check_possible

SAME_PLACE = 1e-6  # rad and m: a file that is the same, written with fewer digits
SAME = 1e-12  # of a number's scale: rounding
# Of what it was in the file, or else of the whole body: what a link keeps at least when links
# that move with it take their share.
KEPT_SHARE = 0.1
FINGER = theta_from_body(1e-3, np.zeros(3), 1e-7 * np.eye(3))  # a gram, 1 cm across


@dataclass
class Changes:
    """New numbers for a robot's file; what is not named stays.

    Attributes:
        origins: by joint, (R, p) of its child's frame in that of its parent link.
        bodies: by link, θ (10,) in its own frame.
        joints: by joint and place (`urdf_text`), what it has there.
        notes: what a user should know, in words.
    """

    origins: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    bodies: dict[str, Array] = field(default_factory=dict)
    joints: dict[str, dict[str, float]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def changes_onto(
    model: SelfModel, more: Additions, robot: FileRobot, same: float = SAME
) -> Changes:
    """What of a robot's file changes.

    Args:
        model: the arm; more: what it has beside.
        robot: the file's content.
        same: of a number's scale, what counts as no change.

    Raises:
        ModelError: the file is not the one that the model was learned with (names the
            differences), or a body cannot exist.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # what is locked was said at reading
        lock = model.provenance.get(LOCKED, {})
        lock = {name: value for name, value in lock.items() if name in robot.joints}
        # A simulator moves links that are not in the model, too, which takes a mass: a gram for
        # those without one, where PyBullet would take 1 kg.
        own = model.tree.joint_names
        loose = [j.child for j in robot.joints.values() if j.kind != "fixed" and j.name not in own]
        bare = {name: FINGER for name in loose if not robot.links[name].any()}
        robot = replace(robot, links=robot.links | bare)
        merged = Merged(robot, model.tree.joint_names, lock)
    read = merged.model(model.tree.floating, model.gravity)
    found = differences(model, read)
    if found:
        raise ModelError(
            f"{robot.file} is not the file that the model was learned with: {'; '.join(found)}. "
            "Learn with this file, or export onto the old one"
        )
    out = Changes()
    if model.source is None:
        out.notes.append(
            f"the model does not know its file, so {robot.file} was compared by its joints alone"
        )
    _joint_places(model, more, merged, out, same)
    _bodies(model, more, merged, out, same)
    for (place, k), name in ((key, model.tree.joint_names[key[1]]) for key in sorted(more.told)):
        out.joints.setdefault(name, {})[place] = float(more.joint[place][k])
    return out


def differences(model: SelfModel, read: SelfModel) -> list[str]:
    """In what the robot of a file differs from the one that a model was learned with, in words.

    Args:
        read: of the file, with the model's joints.
    """
    found = []
    for names, others, what in ((model, read, "lacks"), (read, model, "has")):
        own = {f.joint: f for f in names.frames}
        theirs = {f.joint for f in others.frames}
        extra = [f"joint '{j}' to link '{own[j].name}'" for j in own if j not in theirs]
        found += [f"it {what} {joint}" for joint in extra]
    at = [read.tree.joint_names.index(name) for name in model.tree.joint_names]
    ours, theirs_ = _carriers(model), _carriers(read)
    for k, name in enumerate(model.tree.joint_names):
        if ours[name] != theirs_[name]:
            (p, c), (pp, cc) = ours[name], theirs_[name]
            found.append(f"joint '{name}' joins '{pp}' and '{cc}', was '{p}' and '{c}'")
        elif model.tree.slides[k] != read.tree.slides[at[k]]:
            found.append(f"joint '{name}' turns in one of them and slides in the other")
        elif np.abs(model.axis[k] - read.axis[at[k]]).max() > SAME_PLACE:
            found.append(f"joint '{name}' turns about {read.axis[at[k]]}, was {model.axis[k]}")
        elif model.source is not None:
            was, now = model.source.lam[k], read.lam[at[k]]
            turns = matrix_from_zxz(was[:3]), matrix_from_zxz(now[:3])
            found += _moved(f"joint '{name}'", *turns, now[3:] - was[3:])
    now_frames = {frame.joint: frame for frame in read.frames}
    for frame in model.frames:
        other = now_frames.get(frame.joint)
        if other is not None and other.parent == frame.parent:
            shift = other.position - frame.position
            found += _moved(f"joint '{frame.joint}'", frame.rotation, other.rotation, shift)
    return found


def _carriers(model: SelfModel) -> dict[str, tuple[str, str]]:
    """By joint the moving link (or base) it hangs on and the link it moves."""
    tree = model.tree
    over = [tree.base_name if i == BASE else tree.link_names[i] for i in tree.parent]
    return dict(zip(tree.joint_names, zip(over, tree.link_names, strict=True), strict=True))


def _moved(what: str, before: Array, after: Array, shift: Array) -> list[str]:
    turn, way = float(rotation_angle(before, after)), float(np.linalg.norm(shift))
    if max(turn, way) <= SAME_PLACE:
        return []
    return [f"the origin of {what} is turned by {turn:.3g} rad and moved by {way:.3g} m"]


def _joint_places(
    model: SelfModel, more: Additions, merged: Merged, out: Changes, same: float
) -> None:
    """Origins of moving joints from λ; those on the base with how the base stands."""
    robot, tilt = merged.robot, more.tilt
    at_zero = model.joint_rotation(), model.lam[:, 3:]
    turned, placed = at_joints(*at_zero, -more.offset, model.tree.slides)  # q_measured - offset
    for joint in robot.joints.values():
        rotation, position = joint.rotation, joint.position
        if joint.name in merged.moving:
            k = model.tree.joint_names.index(joint.name)
            _, r, p = merged.place[joint.parent]
            _, own, _ = merged.place[joint.child]
            rotation, position = r.T @ turned[k] @ own, r.T @ (placed[k] - p)
        if tilt is not None and joint.parent == merged.base.name:
            rotation, position = tilt @ rotation, tilt @ position
        worst = np.abs(rotation - joint.rotation).max(), np.abs(position - joint.position).max()
        if not max(worst) <= same:
            out.origins[joint.name] = rotation, position


def _bodies(model: SelfModel, more: Additions, merged: Merged, out: Changes, same: float) -> None:
    """Bodies of the links of the file, so that together they are the model's."""
    whole = model.theta_with_tool()
    whole[-model.tree.n :] += more.dtheta
    whole[-1] += sum(more.loads, np.zeros(10))
    links = {name: [name] for name in model.tree.body_names}
    for name, (number, _, _) in merged.place.items():
        body = merged.body(number).name
        if body in links and name != body:
            links[body].append(name)
    if model.tool is not None and model.tool_link in links:
        out.notes.append(f"the tool of {model.tool.mass:g} kg is in link '{model.tool_link}'")
    if more.loads:
        out.notes.append(f"what the hand carries is in link '{model.tree.link_names[-1]}'")
    for row, (body, members) in enumerate(links.items()):
        frames = [merged.place[name][1:] for name in members]
        file = merged.robot.links
        placed = [move_theta(file[x], r, p) for x, (r, p) in zip(members, frames, strict=True)]
        if np.abs(sum(placed) - whole[row]).max() <= same * np.abs(whole[row]).max():
            continue
        check_possible(whole[row], body)
        shared, factor = _shared(whole[row], np.stack(placed))
        for name, (r, p), before, now in zip(members, frames, placed, shared, strict=True):
            if not np.array_equal(before, now) or file[name] is FINGER:
                out.bodies[name] = move_theta(now, r.T, -r.T @ p)
        if factor < 1.0:
            out.notes.append(
                f"link '{body}' weighs {whole[row, 0]:.3g} kg with all that rides on it: of its "
                f"links {', '.join(members)} those that ride are written {factor:.3g} times as "
                "heavy as in the file"
            )


def _shared(whole: Array, parts: Array) -> tuple[Array, float]:
    """Bodies (k, 10) in one frame that are `whole` (10,) together, after `parts` of the file.

    The first takes what was learned (the heaviest, where the first weighs nothing) and the
    others keep theirs; where nothing possible would be left for it, all others are made lighter
    by one factor, the largest that leaves it its share.

    Returns:
        The bodies, and the factor.
    """
    taker = 0 if parts[0, 0] > 0.0 else int(np.argmax(parts[:, 0]))
    own = parts[taker]
    rest = parts.sum(axis=0) - own
    out = parts.copy()
    out[taker] = whole - rest
    factor, rounding = 1.0, CONSISTENCY_TOLERANCE * float(np.abs(whole).max())
    if not is_consistent(out[taker] - KEPT_SHARE * own, rounding):
        root = np.linalg.inv(np.linalg.cholesky(pseudo_inertia(whole)))
        top = float(np.linalg.eigvalsh(root @ pseudo_inertia(rest) @ root.T)[-1])
        factor = min(1.0, (1.0 - KEPT_SHARE) / max(top, KEPT_SHARE))
        out *= factor
        out[taker] = whole - factor * rest
    return out, factor
