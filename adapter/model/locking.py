"""A model with some of its joints locked: the links behind them become part of those before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from adapter.errors import ModelError
from adapter.model.inertia import move_theta
from adapter.model.self_model import LIMITS, FixedFrame, Limits, SelfModel, Tool
from adapter.model.spatial import Array, at_joints, matrix_from_zxz, z_to_axis, zxz_from_matrix
from adapter.model.tree import BASE, Tree

# Entries of `SelfModel.provenance`: values of locked joints by name, rad or m; and of joints that
# follow another (mimic) its name, the factor and the offset to it, and the unit of both.
LOCKED, FOLLOWS = "locked", "follows"


def restricted(
    model: SelfModel, joints: Sequence[str] | None, lock: Mapping[str, float]
) -> SelfModel:
    """The model with these joints (all where None), the others locked: at zero, or as `lock` says.

    Raises:
        ModelError: a joint that is not there (names the choices), or that is named in both.
    """
    names = model.tree.joint_names
    for name in joints or ():
        model.tree.joint_index(name)
        if name in lock:
            raise ModelError(f"joint '{name}' cannot be learned and locked; do one of them")
    left = [] if joints is None else [name for name in names if name not in joints]
    return locked(model, {**dict.fromkeys(left, 0.0), **lock})


def locked(model: SelfModel, values: Mapping[str, float]) -> SelfModel:
    """The model with joints locked at values, rad or m.

    Links and tool ride on as frames where they were, effects of locked joints are left out;
    bodies that become one have the standard deviation of their sum.

    Raises:
        ModelError: a joint that is not there (names the choices), none is left to move, or the
            last link would be locked where effects of the whole arm (a payload) refer to it.
    """
    if not values:
        return model
    at = {model.tree.joint_index(name): float(value) for name, value in values.items()}
    kept = [k for k in range(model.tree.n) if k not in at]
    if not kept:
        raise ModelError(f"{model.name}: no joint is left to move; locked: {', '.join(values)}")
    of_arm = [str(entry["effect"]) for entry in model.effects if not entry.get("joints")]
    if of_arm and kept[-1] != model.tree.n - 1:
        last = f"{model.tree.link_names[-1]}, the last link"
        raise ModelError(f"{model.name}: {', '.join(of_arm)} may act on {last}, which stays free")
    whole = model.with_base(True)  # the base is a body like the others meanwhile
    carrier, placement = _carriers(whole.tree, whole.lam, at)
    theta, variance = whole.theta.copy(), whole.theta_std**2  # with locked links on their carriers
    for k in at:
        share = move_theta(np.eye(10), *placement[k])  # row i: of a unit of parameter i
        theta[carrier[k] + 1] += whole.theta[k + 1] @ share
        variance[carrier[k] + 1] += variance[k + 1] @ share**2
    lam, moved = _joint_frames(whole.tree, whole.lam, at)
    lam_std = whole.lam_std[kept]
    lam_std[moved] = np.nan  # two frames became one
    source = whole.source
    if source is not None:
        source = replace(source, lam=_joint_frames(whole.tree, source.lam, at)[0])
    number = {BASE: BASE, **{k: i for i, k in enumerate(kept)}}
    tree = replace(
        whole.tree,
        parent=tuple(number[carrier[whole.tree.parent[k]]] for k in kept),
        joint_names=tuple(whole.tree.joint_names[k] for k in kept),
        link_names=tuple(whole.tree.link_names[k] for k in kept),
        slides=tuple(whole.tree.slides[k] for k in kept),
    )
    rows = [0, *(k + 1 for k in kept)]
    frames, tool = _riding(whole, carrier, placement, at)
    names = {whole.tree.joint_names[k]: value for k, value in at.items()}
    changed = replace(
        whole,
        tree=tree,
        lam=lam,
        lam_std=lam_std,
        theta=theta[rows],
        theta_std=np.sqrt(variance[rows]),
        limits=Limits(*(getattr(whole.limits, key)[kept] for key in LIMITS)),
        axis=whole.axis[kept],
        frames=frames,
        source=source,
        tool=tool,
        effects=tuple(e for entry in whole.effects for e in _effect(entry, kept)),
        provenance={**whole.provenance, LOCKED: {**whole.provenance.get(LOCKED, {}), **names}},
        lam_identifiable=None,
        theta_identifiable=None,
        posterior=None,
    )
    return changed.with_base(model.tree.floating)


Placement = dict[int, tuple[Array, Array]]  # of each link, and of the base, in what carries it


def _carriers(tree: Tree, lam: Array, at: Mapping[int, float]) -> tuple[dict[int, int], Placement]:
    """The link (or base) that carries each link now, and the link's rotation and position in it."""
    carrier, placement = {BASE: BASE}, {BASE: (np.eye(3), np.zeros(3))}
    for k, parent in enumerate(tree.parent):
        carrier[k], placement[k] = k, (np.eye(3), np.zeros(3))
        if k in at:
            r, p = placement[parent]
            zero = matrix_from_zxz(lam[k, :3]), lam[k, 3:]
            turn, place = at_joints(*zero, at[k], tree.slides[k])
            carrier[k], placement[k] = carrier[parent], (r @ turn, p + r @ place)
    return carrier, placement


def _joint_frames(tree: Tree, lam: Array, at: Mapping[int, float]) -> tuple[Array, list[int]]:
    """λ of the joints that are left, and those of them (numbered anew) whose frame it changed."""
    carrier, placement = _carriers(tree, lam, at)
    kept, changed, moved = [k for k in range(tree.n) if k not in at], lam.copy(), []
    for k in kept:
        parent = tree.parent[k]
        if carrier[parent] != parent:
            r, p = placement[parent]
            turn = zxz_from_matrix(r @ matrix_from_zxz(lam[k, :3]))
            changed[k] = np.r_[turn, p + r @ lam[k, 3:]]
            moved.append(kept.index(k))
    return changed[kept], moved


def _riding(
    model: SelfModel, carrier: Mapping[int, int], placement: Placement, at: Mapping[int, float]
) -> tuple[tuple[FixedFrame, ...], Tool | None]:
    """Frames and tool on the links that are left."""
    names = {BASE: model.tree.base_name, **dict(enumerate(model.tree.link_names))}
    number = {name: k for k, name in names.items()}
    riding, tool = [], model.tool
    for frame in model.frames:
        r, p = placement[number[frame.parent]]
        parent = names[carrier[number[frame.parent]]]
        rotation, position = r @ frame.rotation, p + r @ frame.position
        riding.append(FixedFrame(frame.name, frame.joint, parent, rotation, position))
    for k in at:
        joint = model.tree.joint_names[k]
        r, p = placement[k]
        r = r @ z_to_axis(model.axis[k]).T  # as the file has it, not turned to the axis
        riding.append(FixedFrame(names[k], joint, names[carrier[k]], r, p))
    if tool is not None:
        k = number[model.tool_link]
        r, p = placement[k]
        inertia = r @ tool.inertia @ r.T
        tool = Tool(tool.mass, p + r @ tool.com, inertia, names[carrier[k]])
    return tuple(riding), tool


def _effect(entry: Mapping[str, Any], kept: Sequence[int]) -> list[dict[str, Any]]:
    """An effect's entry with the joints that are left, renumbered; [] where none of its is."""
    joints = [int(joint) - 1 for joint in entry.get("joints") or ()]
    if not joints:
        return [dict(entry)]
    places = [i for i, joint in enumerate(joints) if joint in kept]
    changed = {**entry, "joints": [kept.index(joints[i]) + 1 for i in places]}
    for key in ("parameters", "std"):
        changed[key] = {
            name: [value[i] for i in places] if np.shape(value)[:1] == (len(joints),) else value
            for name, value in (entry.get(key) or {}).items()
        }
    return [changed] if places else []
