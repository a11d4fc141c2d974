"""What `adapter info LOG --robot R` predicts."""

from __future__ import annotations

import argparse
from typing import Any

from adapter.cli.common import told_of
from adapter.control.teachable import teachable
from adapter.model.self_model import SelfModel
from adapter.screening.screen import RecordingRefused, check_torque
from adapter.signals.matching import matching, most_moved, present
from drivers.files.mcap import Log, read_log


def predict(
    args: argparse.Namespace, robot: SelfModel, log: Log | None = None
) -> tuple[dict[str, Any], list[str]]:
    """What the recording teaches of a robot: figures and lines."""
    whole = log or read_log(args.file, topic=args.topic)
    robot, locked = present(robot, whole.joint_names, whole.path)
    log = told_of(args).log(matching(most_moved(whole), robot), robot)
    if len(log) < len(whole):
        locked.append(f"predicted for {len(log)} of its {len(whole)} samples, where it moves most")
    unit, teaches = "N m", "yes"
    try:
        log, robot, doubt = check_torque(log, robot)
    except RecordingRefused as refusal:
        unit, doubt, teaches = str(refusal), [str(refusal)], "no"
    told = teachable(log, robot)
    expected = told.expected
    if teaches == "yes" and told.rank < told.full_rank:
        teaches = "in part" if told.rank else "no"
    figures = {
        "teaches": teaches,
        "rank": told.rank,
        "full_rank": told.full_rank,
        "torque_std_nm": told.torque_std.tolist(),
        "missing": list(told.missing),
        "effort_unit": unit,
        "parameters": {
            name: {"std": float(std), "unit": unit, "shown": bool(shown)}
            for name, unit, std, shown in zip(
                expected.names, expected.units, expected.std, expected.shown, strict=True
            )
        },
    }
    noise = "  ".join(f"{std:.2g}" for std in told.torque_std)
    parts: dict[str, list[str]] = {}  # of each link and joint what is shown, and how well
    for name, value in figures["parameters"].items():
        part, _, what = name.partition(" ")
        said = parts.setdefault(part, [])
        if value["shown"]:
            said.append(f"{what} ±{value['std']:.2g} {value['unit']}")
    lines = [
        f"can be learned from: {teaches}",
        f"{robot.name}: tells {told.rank} of the {told.full_rank} combinations of parameters that "
        "torques depend on",
        f"torque that no parameters explain, {robot.tree.unit('N m', 'N')}: {noise}",
        *(f"missing: {sentence}" for sentence in told.missing),
        *(f"{part}: {', '.join(said) or 'nothing shown'}" for part, said in parts.items()),
    ]
    return figures, [*locked, *doubt, *lines]
