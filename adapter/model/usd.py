"""A learned model as a layer over a USD asset: its numbers alone, all else stays the asset's."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from adapter import optional
from adapter.errors import ModelError
from adapter.model.filled import filled
from adapter.model.inertia import move_theta, theta_from_body
from adapter.model.onto import SAME_PLACE, changes_onto
from adapter.model.robot_file import MOVING, FileJoint, FileRobot
from adapter.model.self_model import SelfModel, Source
from adapter.model.spatial import Array, matrix_from_quaternion
from adapter.model.urdf_text import Additions


def usd_onto(model: SelfModel, more: Additions, path: str | Path) -> tuple[str, list[str]]:
    """Text of a layer over a USD asset with what was learned, and notes on it in words.

    Limits, and where links stand before a simulation begins, stay the asset's. Its links and joints
    are found by name, and links' frames are taken as those of the URDF, which importers keep.

    Raises:
        ModelError: as `onto.changes_onto`; an asset in other units than m and kg, or a joint
            that does not pass through its link's origin. MeansError: usd-core is not installed.
    """
    names = ("Sdf", "Usd", "UsdGeom", "UsdPhysics")
    Sdf, Usd, UsdGeom, Physics = (optional.load(f"pxr.{name}") for name in names)
    try:
        stage = Usd.Stage.Open(str(path))
    except Exception as error:  # what usd-core raises is no class of its own
        raise ModelError(
            f"{path}: cannot be read as USD ({' '.join(str(error).split())})"
        ) from None
    units = UsdGeom.GetStageMetersPerUnit(stage), Physics.GetStageKilogramsPerUnit(stage)
    if units != (1.0, 1.0):
        raise ModelError(f"{path}: its units are {units[0]:g} m and {units[1]:g} kg, not 1 of each")
    prims = {x.GetName(): x for x in stage.Traverse()}
    robot = _robot(stage, prims, str(path))
    known = replace(model, frames=tuple(x for x in model.frames if x.joint in robot.joints))
    changes = changes_onto(known, more, robot, SAME_PLACE)
    for name, (r, p) in changes.origins.items():
        robot.joints[name] = replace(robot.joints[name], rotation=r, position=p)
    robot.links.update(changes.bodies)
    source, layer = Sdf.Layer.CreateAnonymous(".usda"), Sdf.Layer.CreateAnonymous(".usda")
    source.ImportFromString(filled("usd", replace(known, frames=()), more, robot))
    layer.subLayerPaths.append(str(Path(path).resolve()))
    for key in ("metersPerUnit", "kilogramsPerUnit"):
        layer.pseudoRoot.SetInfo(key, 1.0)
    layer.pseudoRoot.SetInfo("upAxis", UsdGeom.GetStageUpAxis(stage))
    layer.defaultPrim = stage.GetRootLayer().defaultPrim
    top = source.GetPrimAtPath(source.defaultPrim)
    learned = r"physics:(mass|center|diag|princ|local|axis)|physxJointAxis:\w+:(?!max)"
    for name in dict.fromkeys([*changes.bodies, *changes.origins, *changes.joints]):
        at = top.path.AppendPath(f"joints/{name}" if name in robot.joints else name)
        new = Sdf.CreatePrimInLayer(layer, prims[name].GetPath())
        new.SetInfo("apiSchemas", source.GetPrimAtPath(at).GetInfo("apiSchemas"))
        for own in source.GetPrimAtPath(at).properties:
            if re.match(learned, own.name):
                Sdf.CopySpec(source, own.path, layer, new.path.AppendProperty(own.name))
    text = layer.ExportToString().replace("#usda 1.0\n", "#usda 1.0\n#@HEAD@\n", 1)
    return text, changes.notes


def _robot(stage: Any, prims: dict[str, Any], file: str) -> FileRobot:
    """Links and joints of an asset, as a file's content."""
    links, joints = dict[str, Array](), dict[str, FileJoint]()

    def value(prim: Any, key: str, *default: float) -> Array:
        found = prim.GetAttribute(f"physics:{key}").Get()
        found = (found.GetReal(), *found.GetImaginary()) if hasattr(found, "GetReal") else found
        return np.array(default if found is None else found, dtype=float)

    for name, prim in prims.items():
        kind = re.sub(r"Physics(\w+)Joint", r"\1", str(prim.GetTypeName())).lower()
        ends = [prim.GetRelationship(f"physics:body{k}").GetTargets() for k in (0, 1)]
        bodies = [stage.GetPrimAtPath(x[0]) for x in ends if x]
        if (
            kind not in (*MOVING, "fixed")
            or sum(x.HasAPI("PhysicsRigidBodyAPI") for x in bodies) < 2
        ):
            continue  # no joint, or it stands on the world
        r0, r1 = (matrix_from_quaternion(value(prim, f"localRot{k}", 1, 0, 0, 0)) for k in (0, 1))
        p0, p1 = (value(prim, f"localPos{k}", 0, 0, 0) for k in (0, 1))
        if np.abs(p1).max() > SAME_PLACE:
            raise ModelError(f"{file}: joint '{name}' does not pass through its link's origin")
        axis = r1 @ np.eye(3)["XYZ".index(prim.GetAttribute("physics:axis").Get() or "X")]
        for body in bodies:
            turn = matrix_from_quaternion(value(body, "principalAxes", 1, 0, 0, 0))
            moments = np.diag(value(body, "diagonalInertia", 0, 0, 0))
            theta = theta_from_body(value(body, "mass", 0).sum(), np.zeros(3), moments)
            com = value(body, "centerOfMass", 0, 0, 0)  # minus infinity where shapes tell it
            links[body.GetName()] = move_theta(theta, turn, np.where(np.isfinite(com), com, 0.0))
        parent, child = (x.GetName() for x in bodies)
        place = name, kind, parent, child, r0 @ r1.T, p0
        joints[name] = FileJoint(*place, axis, np.full(4, np.nan), None)
    return FileRobot(file, Path(file).stem, links, joints, Source("usd", file))
