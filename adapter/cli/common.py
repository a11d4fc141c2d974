"""What the subcommands share: options, output, the documented robot."""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from adapter.cli.names import effects_named
from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.effects.robots import read_robot
from adapter.learning.known_effects import as_told, learnable, not_learned
from adapter.model.self_model import SelfModel
from adapter.runs.config import Config, config_recorded, config_table, read_config
from adapter.runs.terminal import program_version, warn
from adapter.signals.told import Told
from drivers.files.mcap import Log


def robot_of(args: argparse.Namespace, name: str | None, floating: bool = False) -> SelfModel:
    """The documented robot by name or file, with the joints that the command line asks for."""
    return read_robot(name or "panda", args.joints, floating, args.gravity, dict(args.lock))


def robot_of_log(args: argparse.Namespace, log: Log, floating: bool = False) -> SelfModel:
    """The robot asked for, else the one that the recording carries, else the Panda."""
    carried = log.attachments.get("documented.json")
    if args.robot is not None or carried is None:
        return robot_of(args, args.robot, floating)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "documented.json"
        path.write_bytes(carried)
        return robot_of(args, str(path), floating)


def told_of(args: argparse.Namespace) -> Told:
    """What the command line says of recordings, see `check_told`."""
    efforts = args.gain, args.gears, args.tau is not None, args.trust_log
    load = args.known_load, tuple(args.loaded)
    return Told(tuple(args.turn_or_zero), *efforts, args.learn_gains, *load)


def configure(
    args: argparse.Namespace, recorded: dict[str, Any] | None, robot: SelfModel
) -> Config:
    """Settings: the defaults, over them those a recording was made with, a file, the options.

    Where nobody says otherwise the effects of a real arm are learned, whatever the arm is.

    Args:
        recorded: the configuration in a recording of ours, None elsewhere.
        robot: effects that it has and that can be learned are, where nobody says otherwise.
    """
    as_recorded = args.config is None and recorded is not None
    if as_recorded:
        config, unknown = config_recorded(recorded or {}, "configuration in the recording")
        if names := ", ".join(unknown):
            warn([f"recorded by another version: settings that this one has not: {names}"])
    else:
        config = read_config(args.config)
    learner = config.pipeline.learner
    changes: dict[str, Any] = {}
    if args.effects is not None:
        changes["effects"] = as_told(robot, effects_named(args.effects))
    else:
        unsaid = not learner.effects and not as_recorded
        changes["effects"] = learnable(robot, REAL_ARM_EFFECTS if unsaid else learner.effects)
    warn([f"{robot.name}: {said}" for said in not_learned(robot, changes["effects"])])
    given = {"mode": args.mode, "seed": args.seed}
    changes |= {key: value for key, value in given.items() if value is not None}
    learner = dataclasses.replace(learner, **changes)
    pipeline = dataclasses.replace(config.pipeline, learner=learner)
    excitation = config.excitation
    if args.seed is not None:
        excitation = dataclasses.replace(excitation, seed=args.seed)
    gravity = config.gravity if args.gravity is None else tuple(args.gravity)
    return dataclasses.replace(config, gravity=gravity, pipeline=pipeline, excitation=excitation)


def with_motion(args: argparse.Namespace, config: Config) -> Config:
    """The same with the motion that the command line asks for. Raises SettingsError."""
    asked = {"kind": args.excitation, "share": args.speed, "range_share": args.range}
    said = {k: value for k, value in {**asked, "move": args.move}.items() if value is not None}
    return dataclasses.replace(config, excitation=dataclasses.replace(config.excitation, **said))


def recording_metadata(
    config: Config, robot: SelfModel, command: str, **more: Any
) -> dict[str, Any]:
    """What a recording carries so that a replay repeats the run."""
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    told = {"config": config_table(config), "version": program_version(), "begun": begun}
    return {**told, "robot": robot.name, "command": command, **more}
