"""What is told of a run beside its samples: ROS 2 messages, for recordings and for whoever listens.

/robot_description   the documented robot, as URDF
/tf_static, /tf      the links of the documented and of the learned arm, side by side
/estimates           λ, θ and effects with their standard deviations
/external_wrench     what pushes the last link
/load                what a change at the hand brought
/findings            disagreements with what was learned before
/timing              of the loop's ticks of the last second
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from adapter.errors import ModelError
from adapter.model.filled import filled
from adapter.model.self_model import SelfModel
from adapter.model.spatial import (
    Array,
    at_joints,
    log_rotation,
    matrix_from_zxz,
    quaternion_from_matrix,
    quaternion_product,
    z_to_axis,
)
from adapter.model.tree import BASE
from adapter.model.urdf_text import Additions
from adapter.physics.freedom import Freedom
from adapter.physics.identifiability import frame_observability
from adapter.realtime.showing import View
from adapter.realtime.snapshot import ExternalTorque, Snapshot, SnapshotReader
from adapter.realtime.timing import COUNTED, LoopTiming
from drivers.files.estimates import EstimateNames, estimate_fields
from drivers.files.mcap.writer import ESTIMATES
from drivers.files.messages import Message, TransformsEncoder, header
from drivers.files.ros_types import (
    DIAGNOSTICS,
    ESTIMATE,
    LOAD,
    SHARE_FIELDS,
    STRING,
    TF,
    TIMING,
    WRENCH_STAMPED,
)

DESCRIPTION, TF_MOVING, TF_FIXED = "/robot_description", "/tf", "/tf_static"
WRENCH, LOAD_TOPIC, FINDINGS, TIMING_TOPIC = "/external_wrench", "/load", "/findings", "/timing"
TOPICS = {
    **dict.fromkeys((TF_FIXED, TF_MOVING), TF),
    DESCRIPTION: STRING,
    ESTIMATES: ESTIMATE,
    WRENCH: WRENCH_STAMPED,
    LOAD_TOPIC: LOAD,
    FINDINGS: DIAGNOSTICS,
    TIMING_TOPIC: TIMING,
}
DOCUMENTED, LEARNED = "documented", "learned"
OK, WARN = 0, 1  # levels of a DiagnosticStatus


class ArmFrames:
    """Where one arm's links are: transforms from parents to children, every name with a prefix.

    The frames are those of the robot's URDF: of a joint about another axis than z, the model's
    frame is turned back (`SelfModel.axis`).

    Args:
        model: the arm; its frames and names.
        prefix: `documented` gives the frames documented/panda_link1, ...

    Attributes:
        fixed: (parent, child) of what does not move: the base in the world, what rides on links.
        fixed_rows: (k, 7) of these: x y z in m, quaternion x y z w.
        moving: (parent, child) of every link.
    """

    def __init__(self, model: SelfModel, prefix: str) -> None:
        tree = self._tree = model.tree
        self._axes = np.array([z_to_axis(axis) for axis in model.axis])
        links = [tree.base_name, *tree.link_names]
        names = [f"{prefix}/{link}" for link in links]
        turns = dict(zip(links, (np.eye(3), *self._axes), strict=True))
        self.moving = [(names[i + 1], names[j + 1]) for j, i in enumerate(tree.parent)]
        riding = [(f"{prefix}/{f.parent}", f"{prefix}/{f.name}") for f in model.frames]
        self.fixed = [("world", names[0]), *riding]
        rotations = np.array([np.eye(3), *(turns[f.parent] @ f.rotation for f in model.frames)])
        places = np.array([np.zeros(3), *(turns[f.parent] @ f.position for f in model.frames)])
        self.fixed_rows = _rows(places, quaternion_from_matrix(rotations))
        self.place(matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:])

    @property
    def last(self) -> str:
        """Name of the last link's frame."""
        return self.moving[-1][1]

    def place(self, R0: Array, p: Array) -> None:
        """Take over joint frames R0 (n, 3, 3), p (n, 3) m, in their parents' at q = 0."""
        parents = np.array(self._tree.parent)
        before = np.where((parents == BASE)[:, None, None], np.eye(3), self._axes[parents])
        self._R0 = R0
        left = quaternion_from_matrix(before @ R0)
        about_z = np.array([0.0, 0.0, 0.0, 1.0])  # half a turn
        right = quaternion_from_matrix(np.swapaxes(self._axes, 1, 2))
        half_turn = quaternion_product(quaternion_product(left, about_z), right)
        self._unturned, self._half_turn = quaternion_product(left, right), half_turn
        self._p = np.einsum("jab,jb->ja", before, p)
        slides = np.array(self._tree.slides)
        self._along = np.einsum("jab,jb->ja", before, R0[:, :, 2]) * slides[:, None]
        self._half = 0.5 * ~slides

    def rows(self, q: Array) -> Array:
        """(n, 7) of every link in its parent at joint angles q (n,) rad, or m."""
        c, s = np.cos(self._half * q)[:, None], np.sin(self._half * q)[:, None]
        turned = c * self._unturned + s * self._half_turn  # a product is linear in its factors
        return _rows(self._p + self._along * q[:, None], turned)

    def orientation_of_last(self, q: Array) -> Array:
        """(3, 3) of the last link's frame in the base's."""
        R, turned = np.eye(3), at_joints(self._R0, self._p, q, self._tree.slides)[0]
        for j in self._tree.path_to(self._tree.n - 1):
            R = R @ turned[j]
        return np.asarray(R @ self._axes[-1].T)


def _rows(p: Array, quaternions: Array) -> Array:
    """Rows of `TransformsEncoder` from places and quaternions [w x y z]."""
    return np.concatenate([p, quaternions[:, 1:], quaternions[:, :1]], axis=1)


@dataclass(frozen=True)
class ShownArm:
    """An arm that is shown as documented and as learned; picklable.

    Attributes:
        documented: the model.
        description: URDF text of it; empty where there is none.
        freedom: what no motion of the links shows.
    """

    documented: SelfModel
    description: str
    freedom: Freedom

    @classmethod
    def of(cls, documented: SelfModel) -> ShownArm:
        """From the documented model; runs compiled code, some ms."""
        seen = frame_observability(documented.tree, documented.lam, documented.gravity)
        if documented.source is not None and documented.source.text is not None:
            return cls(documented, documented.source.text, seen.freedom)
        more, text = Additions(documented.tree.n, documented.tree.floating, ()), ""
        with suppress(ModelError):  # bodies that a URDF cannot hold
            text = filled("urdf", documented, more)
        return cls(documented, text, seen.freedom)


def nearest_frames(freedom: Freedom, lam: Array, documented: Array) -> tuple[Array, Array, Array]:
    """Learned joint frames as they are shown beside the documented ones.

    What no motion of the links shows (how the first joint stands about gravity, where along its
    axis the second begins) is as the learner began, anyhow. It is moved to where the
    documentation has it, by a finite motion that changes no link's motion.

    Args:
        freedom: what no motion shows; lam, documented: (n, 6).

    Returns:
        R0 (n, 3, 3), p (n, 3) m, and (n, 6) how far they are off, in the parents' axes, rad and m.
    """
    told = matrix_from_zxz(documented[:, :3]), documented[:, 3:]
    R, p = freedom.nearest(matrix_from_zxz(lam[:, :3]), lam[:, 3:], *told)
    return R, p, np.hstack([log_rotation(R @ np.swapaxes(told[0], 1, 2)), p - told[1]])


def estimate_names(
    joint_names: tuple[str, ...], reader: SnapshotReader | None, arm: ShownArm | None
) -> EstimateNames:
    """Names of an estimate's rows; bodies are numbered where no model names them."""
    bodies = 0 if reader is None else reader.shapes["theta"][0]
    links = () if arm is None else arm.documented.tree.body_names
    if len(links) != bodies:
        links = tuple(f"body{k + 1}" for k in range(bodies))
    return EstimateNames(joint_names, links, () if reader is None else reader.effect_names)


class RunMessages:
    """Makes the messages of one run, in the process that writes or sends them.

    Args:
        names: of the estimate's rows.
        arm: None where no frames are told.
    """

    def __init__(self, names: EstimateNames, arm: ShownArm | None) -> None:
        self._names, self._arm = names, arm
        self._version = self._push_version = 0
        self._told: dict[str, Any] = {}
        self._timing: LoopTiming | None = None
        if arm is None:
            return
        self._frames = {x: ArmFrames(arm.documented, x) for x in (DOCUMENTED, LEARNED)}
        both = self._frames.values()
        self._one = TransformsEncoder(self._frames[DOCUMENTED].moving)
        self._both = TransformsEncoder([pair for frames in both for pair in frames.moving])

    def seen(self, view: View, stamp_ns: int, q: Array) -> list[Message]:
        """All that is new in a view, but for `first`; stamp and q (n,) rad of its newest state."""
        found = list[Message]()
        if view.snapshot is not None and view.snapshot.version:
            found += self.estimate(view.snapshot)
        found += self.frames(stamp_ns, q)
        if view.push is not None:
            found += self.push(view.push, q)
        found += self.news(stamp_ns, view.news)
        return found if view.timing is None else found + self.timing(stamp_ns, view.timing)

    def first(self, stamp_ns: int) -> list[Message]:
        """What is said once, at the beginning; news are then told again."""
        self._told = {}
        if self._arm is None:
            return []
        both = self._frames.values()
        fixed = TransformsEncoder([pair for frames in both for pair in frames.fixed])
        rows = np.concatenate([frames.fixed_rows for frames in both])
        found = [Message(TF_FIXED, TF, stamp_ns, fixed.encode(stamp_ns, rows), latched=True)]
        if self._arm.description:
            text = {"data": self._arm.description}
            found.append(Message(DESCRIPTION, STRING, stamp_ns, text, latched=True))
        return found

    def frames(self, stamp_ns: int, q: Array) -> list[Message]:
        """Where the links are at joint angles q (n,) rad; of the learned arm once there is one."""
        if self._arm is None or not np.isfinite(q).all():
            return []
        encoder = self._both if self._version else self._one
        shown = (DOCUMENTED, LEARNED) if self._version else (DOCUMENTED,)
        rows = np.concatenate([self._frames[name].rows(q) for name in shown])
        return [Message(TF_MOVING, TF, stamp_ns, encoder.encode(stamp_ns, rows))]

    def estimate(self, snapshot: Snapshot) -> list[Message]:
        """An estimate, where it is not the one told last; the learned arm is shown by it."""
        if snapshot.version == self._version:
            return []
        self._version, offset = snapshot.version, None
        if self._arm is not None:
            documented = self._arm.documented.lam
            R, p, offset = nearest_frames(self._arm.freedom, snapshot.lam, documented)
            self._frames[LEARNED].place(R, p)
        values = {
            **{key: getattr(snapshot, key) for key in ("learned", "lambda_source")},
            "lambda_converged": snapshot.lam_converged,
            "theta_converged": snapshot.theta_converged,
            "lambda": snapshot.lam,
            "lambda_std": snapshot.lam_std,
            "offset": offset,
            "theta": snapshot.theta,
            "theta_std": snapshot.theta_std,
            "effects": snapshot.effects,
            "effects_std": snapshot.effects_std,
            "effect_shapes": snapshot.effect_shapes,
            "torque_std": snapshot.torque_std,
        }
        fields = estimate_fields(snapshot.stamp_ns, self._names, values)
        return [Message(ESTIMATES, ESTIMATE, snapshot.stamp_ns, fields)]

    def push(self, push: ExternalTorque, q: Array) -> list[Message]:
        """The wrench on the last link in its own axes, where it is new; q (n,) at its instant."""
        if self._arm is None or push.version == self._push_version:
            return []
        self._push_version = push.version
        if not (np.isfinite(push.wrench).all() and np.isfinite(q).all()):
            return []
        frames = self._frames[LEARNED if push.learned and self._version else DOCUMENTED]
        own = push.wrench.reshape(2, 3) @ frames.orientation_of_last(q)
        force, torque = (dict(zip("xyz", x.tolist(), strict=True)) for x in own)  # N, N m
        fields = {"header": header(push.stamp_ns, frames.last)}
        fields["wrench"] = {"force": force, "torque": torque}
        return [Message(WRENCH, WRENCH_STAMPED, push.stamp_ns, fields)]

    def news(self, stamp_ns: int, told: Mapping[str, Any]) -> list[Message]:
        """What the learner found, where it is not what it told before.

        Args:
            told: "findings", each with "line", "what", "joints", "since_s", "reported_s", "over_s",
                "score" and "size"; "load" with "m", "m_std" and perhaps "cx", "cy", "cz", or None.
        """
        parts = {key: told.get(key) for key in ("findings", "load")}
        changed = {key for key, part in parts.items() if part and part != self._told.get(key)}
        self._told |= {key: parts[key] for key in changed}
        found = []
        if "findings" in changed:
            found.append(self._findings(stamp_ns, parts["findings"] or ()))
        if "load" in changed:
            found.append(self._load(stamp_ns, parts["load"] or {}))
        return found

    def _load(self, stamp_ns: int, load: Mapping[str, float]) -> Message:
        """What the last link carries, in its frame; the centre not-a-number where not known."""
        frame = "" if self._arm is None else self._frames[LEARNED].last
        com = {axis: load.get(f"c{axis}", np.nan) for axis in "xyz"}
        fields = {"header": header(stamp_ns, frame), "mass": load["m"], "mass_std": load["m_std"]}
        return Message(LOAD_TOPIC, LOAD, stamp_ns, {**fields, "com": com})

    def timing(self, stamp_ns: int, timing: LoopTiming) -> list[Message]:
        """Of the loop's ticks since the last one of these; none without a tick."""
        before, self._timing = self._timing, timing
        since = timing if before is None else timing.since(before)
        shares = {
            what: {  # not a number where nothing was counted
                name: np.nan if us is None else us
                for name, us in zip(SHARE_FIELDS, since.of(what).summary_us().values(), strict=True)
            }
            for what in COUNTED
        }
        total = timing.of("loop_us").count
        if not since.of("loop_us").count:
            return []
        fields = {
            "header": header(stamp_ns),
            "ticks": total,
            "missed_deadlines": timing.missed,
            "missed_own": timing.missed_own,
            **shares,
        }
        return [Message(TIMING_TOPIC, TIMING, stamp_ns, fields)]

    def _findings(self, stamp_ns: int, findings: Sequence[Mapping[str, Any]]) -> Message:
        robot = "" if self._arm is None else self._arm.documented.name
        status = [
            {
                "level": WARN if finding["over_s"] is None else OK,
                "name": f"disagreement {k}: {finding['what']}",
                "message": finding["line"],
                "hardware_id": robot,
                "values": [
                    {"key": key, "value": _text(finding[key])}
                    for key in ("what", "joints", "since_s", "reported_s", "over_s", "score")
                ]
                + [{"key": key, "value": _text(x)} for key, x in finding["size"].items()],
            }
            for k, finding in enumerate(findings, 1)
        ]
        fields = {"header": header(stamp_ns), "status": status}
        return Message(FINDINGS, DIAGNOSTICS, stamp_ns, fields)


def table_fields(labels: Sequence[str], table: Array) -> dict[str, Any]:
    """Of a Float64MultiArray of any shape, a label for each dimension."""
    dim = [
        {"label": label, "size": size, "stride": int(np.prod(table.shape[k:]))}
        for k, (label, size) in enumerate(zip(labels, table.shape, strict=True))
    ]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": table.ravel()}


def _text(value: Any) -> str:
    """A value of a finding; empty for what is not known."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
