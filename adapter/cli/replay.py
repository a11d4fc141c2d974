"""`adapter replay`: learn from a recording."""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from typing import Any, Literal

from rich.progress import Progress

from adapter.cli.common import configure, robot_of_log, told_of
from adapter.cli.results import Learned, code_of, conclude
from adapter.errors import SettingsError
from adapter.gap.torque_gains import TorqueGains, as_told
from adapter.model.self_model import SelfModel
from adapter.runs import replay
from adapter.runs.compiling import compile_first
from adapter.runs.config import Config, with_imus
from adapter.runs.contacts import contact_lines
from adapter.runs.outcome import learned_model
from adapter.runs.score import Course, Reference, figures, reference_from
from adapter.runs.terminal import DISAGREEMENT, console, labelled, results_folder, say, show, warn
from adapter.screening.screen import check_torque
from adapter.signals.frame_topics import with_base_motion, with_link_imus
from adapter.signals.importer import read_log
from adapter.signals.matching import matching, present
from drivers.files.mcap import Log


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    first, *more = args.logs
    whole = read_log(first, topic=args.topic, beside="imus" if args.base is None else "frames")
    recorded = whole.metadata.get("config")
    robot = robot_of_log(args, whole, args.base is not None)
    recorded = recorded if isinstance(recorded, dict) else None
    config = configure(args, recorded, robot)
    robot, locked = present(config.apply(robot), whole.joint_names, whole.path)
    reference = reference_from(args.truth, robot)
    logs = [_joined(args, whole, robot)]
    logs += [matching(read_log(path, topic=args.topic), robot) for path in more]
    logs, robot, gains = _as_told(args, logs, robot)
    log = replay.one_after_other(logs) if more else logs[0]
    imus: tuple[str, ...] = ()
    if args.base is None:
        log, imus = with_link_imus(log, robot, args.imu)
    log.warnings.extend(locked)
    warn(log.warnings)
    fitted, notes = replay.fitted_to(log, config.pipeline.filter)
    warn(notes)
    learner = replace(config.pipeline.learner, base_wrench=args.base_wrench == "zero")
    pipeline = replace(config.pipeline, filter=fitted, learner=learner)
    config = replace(config, pipeline=with_imus(pipeline, imus))
    compile_first(robot, config.pipeline, args.every, say)
    result = _learn(args, log, robot, config)
    front_end, source = result.pipeline.front_end, ", ".join(map(str, args.logs))
    numbers = _figures(args, log, robot, reference, result)
    if front_end.first_moving_ns is None:
        warn([f"{source}: the arm never moves (no |dq| above 0.02 rad/s); nothing is learned"])
    numbers["torque_gains"] = None if gains is None else gains.as_dict()
    held_out = None if args.validate_from is None else replay.from_s(log, args.validate_from)
    if args.validate is not None:
        frames: Literal["", "frames"] = "" if args.base is None else "frames"
        other = _joined(args, read_log(args.validate, topic=args.topic, beside=frames), robot)
        held_out = told_of(args).log(other, robot, 1.0 if gains is None else gains.gain)
    if held_out is not None:
        model = learned_model(result.outcome, robot)
        for key, judged in (("", model), ("documented_", robot)):
            error = replay.held_out_rms(held_out, judged, config.pipeline)
            numbers["theta"][f"{key}validation_torque_rmse_nm"] = error.value.tolist()
            numbers["theta"][f"{key}validation_torque_rmse_std_nm"] = error.std.tolist()
    folder = results_folder(args.out, "replay")
    learned = Learned(result.outcome, robot, reference, front_end)
    conclude(args, folder, learned, numbers, source)
    show(f"{numbers['times_real_time']:.1f} times faster than real time")
    return code_of(result.outcome)


def _figures(
    args: argparse.Namespace,
    log: Log,
    robot: SelfModel,
    reference: Reference,
    result: replay.Replay,
) -> dict[str, Any]:
    front_end = result.pipeline.front_end
    taken = result.samples, front_end.refused, front_end.first_moving_ns
    course = Course(*taken, front_end.delay_s, result.ticks.summary_us())
    return figures(
        result.outcome,
        robot,
        reference,
        course,
        warnings=[
            *log.warnings,
            *front_end.messages,
            *result.outcome.lam_notes,
            *contact_lines(result.contacts, robot.tree.joint_names, front_end.start_s),
        ],
        start_s=front_end.start_s,
        contacts=result.contacts,
        recording=", ".join(map(str, args.logs)),
        recordings=list(map(str, args.logs)),
        robot=robot.name,
        every=args.every,
        times_real_time=result.span_s / max(result.wall_s, 1e-9),
        noise=replay.noise_levels(log),
        gaps=[
            {"after_s": 1e-9 * stamp - front_end.start_s, "length_s": length}
            for stamp, length in front_end.gaps
        ],
    )


def _as_told(
    args: argparse.Namespace, logs: list[Log], robot: SelfModel
) -> tuple[list[Log], SelfModel, TorqueGains | None]:
    """Recordings as the robot means them, how it stands, and the gains where they were learned.

    Raises:
        RecordingRefused: joints or efforts are not the robot's, and nobody says how they are told.
    """
    told = told_of(args)
    if told.learn and robot.tree.floating:
        raise SettingsError("--tau-gain fit needs a fixed base; give --tau-gain G1,G2,...")
    taught: list[Log] = []
    if told.learn:
        say("learning the gains of the drives")
        until = args.validate_from
        taught = logs if until is None else [replay.from_s(x, 0.0, until) for x in logs]
    logs, gains = as_told(logs, robot, told, taught)
    if gains is not None:
        logs[0].warnings.extend([*gains.notes, *gains.words()])
    if not robot.tree.floating:
        for k, log in enumerate(logs):
            logs[k], robot, said = check_torque(log, robot)
            logs[0].warnings.extend(said)
    return logs, robot, gains


def _joined(args: argparse.Namespace, log: Log, robot: SelfModel) -> Log:
    """The recording as the robot has it, with the base's motion where it floats."""
    log = matching(log, robot)
    return log if args.base is None else with_base_motion(log, robot, args.base)


def _learn(args: argparse.Namespace, log: Log, robot: SelfModel, config: Config) -> replay.Replay:
    if args.validate_from is not None and not 0.0 < args.validate_from < replay.last_s(log):
        span = f"(0 to {replay.last_s(log):.1f} s)"
        raise SettingsError(f"--validate-from {args.validate_from} is outside the recording {span}")
    with Progress(console=console, transient=True, disable=args.quiet) as bar:
        task = bar.add_task("learning", total=len(log))
        options = replay.ReplayOptions(
            every=args.every,
            until_s=args.validate_from,
            progress=lambda done: bar.update(task, completed=done),
            resume=args.resume,
            say=None if args.quiet else partial(labelled, f"{DISAGREEMENT}:", "yellow"),
        )
        return replay.replay(log, robot, config.pipeline, options)
