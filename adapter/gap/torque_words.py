"""What is wrong with a recording's torques, in one sentence with the evidence and the remedy."""

from __future__ import annotations

import numpy as np

from adapter.gap.torque_units import UNITS, Judge, Reading
from adapter.records import Array
from adapter.tree import Tree


def unit(reading: Reading) -> str | None:
    """Name of the unit whose factor all joints have, whatever the sign."""
    size = np.abs(reading.detail)
    return UNITS.get(float(size[0])) if np.ptp(size) == 0 else None


def in_words(best: Reading, as_is: Reading, judge: Judge, tree: Tree, tau: Array) -> str:
    """What a reading says, with the evidence and what to do."""
    names = [tree.joint_names[j] for j in best.joints]
    before, after = (judge.error(r.tau) for r in (as_is, best))
    joints = slice(None) if len(best.joints) == len(before) else list(best.joints)
    worst = f"the model is off by {rms(before[joints]):.3g} N m"
    if best.kind == "sign":
        which = "all joints" if len(names) == tree.n else ", ".join(names)
        return (
            f"the torque of {which} has the wrong sign: {worst} there as recorded and by "
            f"{rms(after[joints]):.3g} N m with the sign turned; turn it in the recording, tau "
            "is positive along the joint's axis and holds the arm against gravity."
        )
    if best.kind == "scale":
        name, size = unit(best), np.abs(best.detail)
        same = np.ptp(size) == 0
        what = f"{size[0]:.4g} times" if same else ", ".join(f"{x:.3g}" for x in size) + " times"
        turned = " and with the opposite sign" if np.all(best.detail < 0) else ""
        guess = name or "gears (torque of the motors), motor currents or another unit"
        return (
            f"the torques are {what} what the model needs{turned} (rms {rms(tau):.3g} against "
            f"{rms(judge.model):.3g} N m, {rms(after):.3g} N m off after division): {guess}? "
            "Convert them to N m at the link side (`adapter import` does)."
        )
    if best.kind == "gravity":
        return (
            f"the torques hold no gravity: {worst} as recorded and by {rms(after):.3g} N m when "
            "the model's gravity torque is added; record the measured joint torques, gravity "
            "included."
        )
    if best.kind == "mounting":
        g = ", ".join(f"{x:.1f}" for x in best.detail)
        return (
            f"gravity acts along [{g}] m/s² of the base and not as in the model: {worst} as "
            f"recorded and by {rms(after):.3g} N m so; give the model the gravity of the mounting."
        )
    order = [tree.joint_names[int(k)] for k in best.detail]
    pairs = ", ".join(f"{order[j]} holds that of {tree.joint_names[j]}" for j in best.joints)
    return (
        f"the torques are in another order than the positions, the column of {pairs}: {worst} "
        f"there as recorded and by {rms(after[joints]):.3g} N m put in order; record them in the "
        "order of the joint names."
    )


def rms(x: Array) -> float:
    """Root of the mean square of all of x."""
    return float(np.sqrt(np.mean(np.square(x))))
