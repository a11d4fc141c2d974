"""`adapter replay`: learn from a recording."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from rich.progress import Progress

from adapter.cli.common import configure, effort_unit_of, robot_of_log
from adapter.cli.results import Learned, code_of, conclude
from adapter.errors import SettingsError
from adapter.gap.screen import check_torque
from adapter.gap.torque_gains import TorqueGains, in_newton_metres
from adapter.model.self_model import SelfModel
from adapter.runs.compiling import compile_first
from adapter.runs.config import Config, with_imus
from adapter.runs.contacts import contact_lines
from adapter.runs.outcome import learned_model
from adapter.runs.replay import (
    Replay,
    ReplayOptions,
    fitted_to,
    from_s,
    held_out_rms,
    last_s,
    noise_levels,
    one_after_other,
)
from adapter.runs.replay import replay as learn_from
from adapter.runs.score import Course, Reference, figures, reference_from
from adapter.runs.terminal import console, labelled, results_folder, say, show, warn
from adapter.signals.base_motion import with_base_motion
from adapter.signals.link_imus import with_link_imus
from adapter.signals.matching import matching, most_moved, present
from drivers.files.mcap import AnyLog, Log, StoredLog, open_log

PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    first, *more = args.logs
    whole = open_log(first, topic=args.topic, frames=args.base is not None, imus=True)
    recorded = whole.metadata.get("config")
    robot = robot_of_log(args, whole, args.base is not None)
    recorded = recorded if isinstance(recorded, dict) else None
    config = configure(args, recorded, robot)
    robot, locked = present(config.apply(robot), whole.joint_names, whole.path)
    reference = reference_from(args.truth, robot)
    logs = [_joined(args, whole, robot)]
    logs += [matching(open_log(path, topic=args.topic), robot) for path in more]
    logs, gains = _in_newton_metres(args, logs, robot)
    log = one_after_other(logs) if more else logs[0]
    imus: tuple[str, ...] = ()
    if args.base is None and (isinstance(log, Log) or args.imu):
        log, imus = with_link_imus(_in_memory(log), robot, args.imu)
    log.warnings.extend(locked)
    warn(log.warnings)
    fitted, notes = fitted_to(log, config.pipeline.filter)
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
    held_out = _held_out(args, log, robot)
    if held_out is not None and args.validate is not None:
        held_out = _as_understood(args, held_out, robot, gains)
    if held_out is not None:
        model = learned_model(result.outcome, robot)
        for key, judged in (("", model), ("documented_", robot)):
            error = held_out_rms(held_out, judged, config.pipeline)
            numbers["theta"][f"{key}validation_torque_rmse_nm"] = error.value.tolist()
            numbers["theta"][f"{key}validation_torque_rmse_std_nm"] = error.std.tolist()
    folder = results_folder(args.out, "replay")
    learned = Learned(result.outcome, robot, reference, front_end)
    conclude(args, folder, learned, numbers, source)
    show(f"{numbers['times_real_time']:.1f} times faster than real time")
    return code_of(result.outcome)


def _figures(
    args: argparse.Namespace, log: AnyLog, robot: SelfModel, reference: Reference, result: Replay
) -> dict[str, Any]:
    front_end = result.pipeline.front_end
    course = Course(
        result.samples,
        front_end.refused,
        front_end.first_moving_ns,
        front_end.delay_s,
        _percentiles(result),
    )
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
        noise=noise_levels(log),
        gaps=[
            {"after_s": 1e-9 * stamp - front_end.start_s, "length_s": length}
            for stamp, length in front_end.gaps
        ],
    )


def _in_newton_metres(
    args: argparse.Namespace, logs: list[AnyLog], robot: SelfModel
) -> tuple[list[AnyLog], TorqueGains | None]:
    """Recordings with efforts in N m, and the gains where they were learned.

    Gains are learned from what lies in memory: recordings in a file are brought there for it.

    Raises:
        RecordingRefused: nobody says a unit, and efforts are motor currents.
    """
    unit = effort_unit_of(args)
    if robot.tree.floating and not unit.is_given:
        return logs, None
    if unit.learn and robot.tree.floating:
        raise SettingsError("--tau-gain fit needs a fixed base; give --tau-gain G1,G2,...")
    until = args.validate_from
    taught = logs if until is None else [from_s(x, 0.0, until) for x in logs]
    if unit.learn:
        say("learning the gains of the drives")
        logs = [_in_memory(x) for x in logs]
    known = [_in_memory(x) for x in taught] if unit.learn else []
    logs, gains = in_newton_metres(logs, robot, unit, known)
    if gains is not None:
        logs[0].warnings.extend([*gains.notes, *gains.words()])
    if not robot.tree.floating:
        for log in logs:
            check_torque(most_moved(log), robot, unit.is_given and gains is None)
    return logs, gains


def _as_understood(
    args: argparse.Namespace, log: AnyLog, robot: SelfModel, gains: TorqueGains | None
) -> AnyLog:
    """Another recording with efforts in N m as those that were learned from."""
    factors = effort_unit_of(args).factors(robot.tree.joint_names)
    if gains is not None:
        factors = factors * gains.gain
    return log.changed(lambda piece: replace(piece, tau=piece.tau * factors))


def _joined(args: argparse.Namespace, log: AnyLog, robot: SelfModel) -> AnyLog:
    """The recording as the robot has it, with the base's motion where it floats."""
    log = matching(log, robot)
    return log if args.base is None else with_base_motion(_in_memory(log), robot, args.base)


def _in_memory(log: AnyLog) -> Log:
    return log.in_memory() if isinstance(log, StoredLog) else log


def _learn(args: argparse.Namespace, log: AnyLog, robot: SelfModel, config: Config) -> Replay:
    if args.validate_from is not None and not 0.0 < args.validate_from < last_s(log):
        raise SettingsError(
            f"--validate-from {args.validate_from} is outside the recording "
            f"(0 to {last_s(log):.1f} s)"
        )
    shown = nullcontext() if args.quiet else Progress(console=console, transient=True)
    with shown as bar:
        task = None if bar is None else bar.add_task("learning", total=len(log))

        def progress(done: int) -> None:
            if bar is not None and task is not None:
                bar.update(task, completed=done)

        return learn_from(
            log,
            robot,
            config.pipeline,
            ReplayOptions(
                every=args.every,
                until_s=args.validate_from,
                progress=progress,
                resume=args.resume,
                say=None if args.quiet else tell,
            ),
        )


def tell(line: str) -> None:
    """A new disagreement, when it is found."""
    labelled("new disagreement:", "yellow", line)


def _held_out(args: argparse.Namespace, log: AnyLog, robot: SelfModel) -> AnyLog | None:
    """What to score on, or None."""
    if args.validate_from is not None:
        return from_s(log, args.validate_from)
    if args.validate is not None:
        other = open_log(args.validate, topic=args.topic, frames=args.base is not None)
        return _joined(args, other, robot)
    return None


def _percentiles(result: Replay) -> dict[str, float | None]:
    if not result.ticks.count:
        return dict.fromkeys(PERCENTILES)
    return {k: 1e-3 * result.ticks.percentile_ns(share) for k, share in PERCENTILES.items()}
