"""`adapter run`: learn live, at the arm's own rate."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Any

from adapter.cli.common import (
    UsageError,
    add_learning_options,
    configure,
    console,
    program_version,
    recording_metadata,
    robot_of,
    warn,
)
from adapter.cli.display import make_display
from adapter.cli.results import conclude, results_folder
from adapter.cli.simulated import Simulation, simulation
from adapter.config import REAL_ARM_EFFECTS, Config
from adapter.controller import ExcitationController
from adapter.effects.active import lasting_effects
from adapter.effects.bodies import with_bodies
from adapter.excitation import MotionLimits
from adapter.feedforward import Feedforward, ModelFeedforward
from adapter.front_end import FrontEnd
from adapter.live import describe_estimate, learner_job
from adapter.model import SelfModel
from adapter.model_file import dumps
from adapter.motion_plan import plan_lines
from adapter.pipeline import make_front_end
from adapter.realtime.jobs import RecordingJob, WatchJob
from adapter.realtime.learned import LearnedFeedforward
from adapter.realtime.loop import LiveOptions, LiveResult, run_live
from adapter.score import figures, reference_from
from drivers.faulty import FaultyDriver, with_faults
from drivers.interface import Driver
from drivers.registry import HARDWARE, open_driver, split_address

FEEDFORWARD = ("none", "documented", "learned")
EXIT_ARM, EXIT_LEARNER = 3, 4
# Of the documented speed, so that 20 ms of a torque that is held, the longest a Franka robot puts
# up with, do not bring a joint to its limit.
REAL_SHARE = 0.75
SLOW_S = 10.0  # an arm that may be real moves at a tenth of the speed for so long


def add_parser(commands: Any) -> None:
    """Declare the subcommand."""
    parser = commands.add_parser(
        "run",
        help="learn live",
        description="Move an arm on smooth random trajectories (or only listen) and learn λ and "
        "θ at its rate, in real time. Exit codes: 0 done, 2 wrong use, 3 the arm failed, "
        "4 the learner failed.",
    )
    parser.add_argument(
        "--driver",
        default="pybullet:panda",
        metavar="ADDRESS",
        help="pybullet:panda (default), log:FILE, fci://HOST, can://CHANNEL?interface=...",
    )
    parser.add_argument(
        "--allow-motion",
        action="store_true",
        help="leave to move an arm that may be real (fci, can): prints the plan, goes at a tenth "
        "of the speed for 10 s, stops when this terminal closes. Without it, only listen",
    )
    parser.add_argument("--duration", type=float, default=30.0, metavar="S", help="default 30")
    parser.add_argument(
        "--scenario",
        metavar="NAME",
        help="of the simulated arm: nominal, bent_link, payload_at_20s, friction, wall_mounted",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="option of the scenario, as in --set mass=0.3 --set noise=none",
    )
    parser.add_argument("--passive", action="store_true", help="only listen; do not move the arm")
    parser.add_argument(
        "--fault", metavar="LIST", help="inject faults into the samples, as in lost=0.01,nan=0.001"
    )
    parser.add_argument(
        "--feedforward",
        choices=FEEDFORWARD,
        default="none",
        help="model that helps the controller; its worth is told as tracking error",
    )
    parser.add_argument("--record", type=Path, metavar="FILE", help="default: in the results")
    parser.add_argument("--no-record", action="store_true", help="keep no recording")
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="keep the learner's state")
    add_learning_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    if not args.duration > 0.0:
        raise UsageError(f"--duration must be above zero, got {args.duration}")
    robot = robot_of(args.robot)
    scheme, _ = split_address(args.driver)
    world = simulation(args.driver, args.scenario, args.set, args.seed or 0)
    default_effects = REAL_ARM_EFFECTS if world is None else world.effects
    config = configure(args, None, default_effects, robot)
    maybe_real = world is None and scheme in HARDWARE
    may_move = args.allow_motion and not args.passive
    if maybe_real and may_move and not config.excitation.slow_s:
        share = min(config.excitation.share, REAL_SHARE)
        gentle = dataclasses.replace(config.excitation, slow_s=SLOW_S, share=share)
        config = dataclasses.replace(config, excitation=gentle)
    if world is not None and config.gravity is None:
        robot = world.mounted(robot)
    robot = config.apply(robot)
    folder = results_folder(args, "run")
    truth = args.truth or _write_truth(world, folder)
    reference = reference_from(truth, robot)
    builders = {} if world is None else {scheme: world.driver}
    driver = open_driver(args.driver, builders, robot.tree.joint_names, may_move)
    if args.fault is not None:
        driver = with_faults(driver, args.fault, args.seed or 0)
    if maybe_real and not driver.can_move:
        console.print("only listening; --allow-motion lets the arm move")
    front_end = make_front_end(robot, config.pipeline)
    result = _go(args, config, robot, driver, front_end, folder, truth, maybe_real)
    for line in result.timing.lines():
        console.print(line)
    if isinstance(driver, FaultyDriver):
        console.print(driver.account.line())
    warn(([result.fault] if result.fault else []) + result.troubles + result.intake.notes)
    if result.collected is None:
        console.print("[red]error:[/] the learner ended early; the recording is complete")
        return EXIT_LEARNER
    _conclude(args, folder, robot, reference, front_end, result, config.excitation.slow_s)
    return EXIT_ARM if result.fault else 0


def _write_truth(world: Simulation | None, folder: Path) -> Path | None:
    """Write the scenario's truth; errors are against it where a scenario was asked for."""
    if world is None:
        return None
    path = folder / "truth.json"
    world.scenario.write_truth(path)
    return path if world.asked_for else None


def _controller(
    args: argparse.Namespace, config: Config, robot: SelfModel, driver: Driver
) -> ExcitationController | None:
    if args.passive or not driver.can_move:
        return None
    forward: Feedforward | None = None
    tool = None if robot.tool is None else robot.tool.theta()
    if args.feedforward == "documented":
        forward = ModelFeedforward.of(robot)
    elif args.feedforward == "learned":
        effects = config.pipeline.learner.effects
        whole = with_bodies(robot)
        lasting = lasting_effects(whole.effects, robot.tree.n)
        known = [active for active in lasting if active.effect.name not in effects]
        forward = LearnedFeedforward(robot.tree, whole.gravity, effects, tool, known)
    return ExcitationController(MotionLimits.of(robot), config.excitation, feedforward=forward)


def _go(
    args: argparse.Namespace,
    config: Config,
    robot: SelfModel,
    driver: Driver,
    front_end: FrontEnd,
    folder: Path,
    truth: Path | None,
    maybe_real: bool,
) -> LiveResult:
    """The live run itself; an arm that may be real shows its plan and has a dead man's switch."""
    recording, controller = None, _controller(args, config, robot, driver)
    duration_s = args.duration + (config.excitation.slow_s if controller is not None else 0.0)
    if not args.no_record:
        metadata = recording_metadata(
            config,
            robot,
            shlex.join(sys.argv[1:]),
            driver=args.driver,
            scenario=args.scenario,
            commands_without_gravity=driver.adds_gravity,
        )
        attachments = {"documented.json": dumps(robot).encode()}
        if truth is not None:
            attachments["truth.json"] = truth.read_bytes()
        path = args.record or folder / "recording.mcap"
        recording = RecordingJob(
            path,
            metadata,
            attachments,
            overwrite=args.record is None,
            describe=describe_estimate,
        )
    watch = None if args.quiet else WatchJob(partial(make_display, duration_s))

    def show_plan() -> None:
        warn(driver.intake.notes)  # who holds the arm, say; again with what came later at the end
        if maybe_real and controller is not None and controller.reference is not None:
            names = robot.tree.joint_names
            lines = plan_lines(controller.reference, controller.limits, names, duration_s)
            console.print("\n".join(lines), soft_wrap=True)

    return run_live(
        driver,
        front_end,
        controller=controller,
        learner=learner_job(
            robot, config.pipeline, args.checkpoint, args.resume, aloud=not args.quiet
        ),
        recording=recording,
        watch=watch,
        options=LiveOptions(duration_s, deadman=maybe_real and controller is not None),
        before_motion=show_plan,
        say=lambda line: console.print(line, soft_wrap=True),
    )


def _conclude(
    args: argparse.Namespace,
    folder: Path,
    robot: SelfModel,
    reference: Any,
    front_end: FrontEnd,
    result: LiveResult,
    slow_s: float,
) -> None:
    """Figures, files, headline; times of convergence count from the end of a slow start."""
    outcome, first_ns = result.collected, front_end.first_moving_ns
    if first_ns is not None and result.tracking is not None:
        first_ns += round(1e9 * slow_s)
    refused = dict(front_end.refused)
    lost = result.unlearned + result.passed_on - outcome.learned
    if lost:
        refused["not_reached_learner"] = lost
    numbers = figures(
        outcome,
        robot,
        reference,
        samples=result.samples,
        refused=refused,
        first_moving_ns=first_ns,
        tick_us=result.timing.tick_us,
        missed_deadlines=result.timing.missed_deadlines,
        delay_s=front_end.delay_s,
        warnings=[*front_end.messages, *result.troubles],
        robot=robot.name,
        driver=args.driver,
        scenario=args.scenario,
        program=f"panda-adapter {program_version()}",
        timing=result.timing.as_dict(),
        granted=[grant.line for grant in result.grants],
        ended=result.ended,
        fault=result.fault,
        intake={**vars(result.intake), "refused": dict(result.intake.refused)},
        set_aside=result.set_aside,
        skipped=result.skipped,
        restarts=result.restarts,
        recorded=result.recorded,
        unrecorded=result.unrecorded,
        tracking=result.tracking,
        feedforward=args.feedforward,
    )
    conclude(args, folder, outcome, robot, reference, numbers, front_end, args.driver)
