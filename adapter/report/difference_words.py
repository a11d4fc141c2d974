"""A difference of two models in words and for JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from adapter.runs.compare import JointDifference, ModelDifference

NO_DATA = "no data can show it"
MOSTLY = 0.5  # share that data can show, below which it is told


def difference_lines(found: ModelDifference) -> list[str]:
    """A line for each joint that differs, and what all of it does."""
    lines = [line for joint in found.joints if (line := _joint_line(joint))]
    lines += found.others
    if not lines:
        return [f"{found.names[0]} and {found.names[1]} are the same"]
    change = " ".join(f"{joint.torque_rms_nm:.3g}" for joint in found.joints)
    size = " ".join(f"{joint.torque_size_nm:.3g}" for joint in found.joints)
    lines.append(f"torque, rms by joint: {change} N m, of {size}")
    hand = f"{1e3 * found.hand_rms_m:.3g} mm rms, {1e3 * found.hand_max_m:.3g} mm at most"
    lines.append(f"{found.hand} stands elsewhere by {hand}")
    return lines


def _joint_line(joint: JointDifference) -> str:
    parts = []
    if joint.frame_moved:
        turn, shift = np.degrees(joint.turn_rad), 1e3 * joint.shift_m
        tail = _tail(joint.frame_z, float(joint.frame_shown))
        parts.append(f"frame turned by {turn:.3g}° and moved by {shift:.3g} mm{tail}")
    if joint.body_changed:
        a, b = joint.mass
        way = 1e3 * float(np.linalg.norm(joint.com[1] - joint.com[0]))
        sizes = [float(np.trace(tensor)) / 3.0 for tensor in joint.inertia]
        parts.append(
            f"{joint.link} {a:.4g} -> {b:.4g} kg, centre moved by {way:.3g} mm, mean inertia "
            f"{sizes[0]:.3g} -> {sizes[1]:.3g} kg m²{_tail(joint.body_z, joint.body_shown)}"
        )
    for key, (before, after, z) in joint.effects.items():
        numbers = " -> ".join("none" if x is None else f"{x:.3g}" for x in (before, after))
        parts.append(f"{key} {numbers}{_tail(z, 1.0)}")
    return f"{joint.joint}: {'; '.join(parts)}" if parts else ""


def _tail(z: float | None, shown: float) -> str:
    """Standard deviations, and how much of a difference no data can show."""
    notes = [f"{z:.1f} standard deviations"] if z is not None else []
    if shown < MOSTLY:
        notes.append(f"data can show {100.0 * shown:.1g} % of it" if shown else NO_DATA)
    return f" ({', '.join(notes)})" if notes else ""


def difference_json(found: ModelDifference) -> dict[str, Any]:
    """Everything, ready for JSON."""
    keys = ("joint", "link", "frame_z", "frame_shown", "body_z", "body_shown", "body_parameter")
    joints = [
        {
            **{key: getattr(joint, key) for key in keys},
            "frame_turn_deg": float(np.degrees(joint.turn_rad)),
            "frame_shift_mm": 1e3 * joint.shift_m,
            "mass_kg": list(joint.mass),
            "com_m": [com.tolist() for com in joint.com],
            "inertia_kg_m2": [tensor.tolist() for tensor in joint.inertia],
            "effects": {
                key: dict(zip(("before", "after", "z"), numbers, strict=True))
                for key, numbers in joint.effects.items()
            },
            "torque_rms_nm": joint.torque_rms_nm,
            "torque_size_nm": joint.torque_size_nm,
        }
        for joint in found.joints
    ]
    return {
        "models": list(found.names),
        "joints": joints,
        "hand": found.hand,
        "hand_rms_mm": 1e3 * found.hand_rms_m,
        "hand_max_mm": 1e3 * found.hand_max_m,
        "others": list(found.others),
        "lines": difference_lines(found),
    }
