"""`adapter run`: learn live, at the arm's own rate."""

from __future__ import annotations

import argparse
import dataclasses
import secrets
import shlex
import socket
import sys
from collections.abc import Callable
from functools import partial
from glob import escape
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from adapter import optional
from adapter.cli.agreement import agree, need_somebody, reading
from adapter.cli.common import configure, recording_metadata, robot_of, with_motion
from adapter.cli.display import LiveTable
from adapter.cli.exit_codes import ExitCode
from adapter.cli.publishing import publisher_job, together
from adapter.cli.results import Learned, code_of, conclude
from adapter.cli.run_options import ANY, simulated
from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.designed import Designer
from adapter.control.excitation import RandomMotion
from adapter.control.feedforward import Feedforward, ModelFeedforward, not_learned
from adapter.control.free_path import ArmInCell, Draw, FreeMotion
from adapter.control.information import Information
from adapter.control.limits import MotionLimits, another_robot, need_complete
from adapter.control.observer import ContactObserver
from adapter.control.path_motion import PathMotion
from adapter.control.played import Player
from adapter.control.resting import CarriedWeight
from adapter.control.settings import DESIGNED, gentle
from adapter.effects.active import with_bodies
from adapter.errors import UsageError
from adapter.model.model_file import dumps
from adapter.model.self_model import SelfModel
from adapter.realtime.following import FeedforwardBound, FollowingObserver, LearnedFeedforward
from adapter.realtime.jobs import Jobs, RecordingJob
from adapter.realtime.loop import LiveOptions, LiveResult, run_live
from adapter.realtime.run_messages import ShownArm
from adapter.realtime.showing import DisplayJob
from adapter.runs import terminal
from adapter.runs.compiling import compile_first
from adapter.runs.config import Config, with_imus
from adapter.runs.contacts import contact_lines, contacts_of
from adapter.runs.live import learner_job
from adapter.runs.pipeline import make_front_end
from adapter.runs.score import Course, figures, reference_from
from adapter.signals.front_end import FrontEnd
from adapter.signals.matching import counted, present
from adapter.signals.motion_file import read_motion
from adapter.view.foxglove_view import free_port, need_foxglove
from adapter.view.now import KnownRun
from adapter.view.page import PERIOD_S, make_view
from adapter.view.server import HOST, address, bind
from drivers.faults.driver import FaultyDriver, with_faults
from drivers.files.mcap import read_log
from drivers.interface import Driver
from drivers.registry import joint_count, maybe_real, open_driver, split_address

USUAL_S = 30.0
SIMULATED_BY = "adapter.cli.simulated"  # loaded by name where it is used: brings PyBullet
AS_TOLD = ("set_aside", "skipped", "restarts", "recorded", "unrecorded", "tracking")  # by the loop


class SimulationLike(Protocol):
    """A simulated arm (`adapter.cli.simulated.Simulation`)."""

    scenario: Any
    asked_for: bool

    def driver(self, rest: str) -> Driver:
        """What opens it."""
        ...


@dataclasses.dataclass(frozen=True)
class RunPlan:
    """What a command line asks for.

    Attributes:
        robot: documented model, with the gravity and the tool that the user told of.
        config: all settings.
        world: the simulated arm; None for one that may be real. The learner is told nothing of it.
        maybe_real: the arm may be a real one.
        feedforward: model that helps the controller; where nobody says, the documented one helps a
            designed motion, which feedback alone would follow with too large an error.
        duration_s: of the motion, without the slow start of an arm that may be real.
        played: the motion of a file; None for one that is drawn here.
    """

    robot: SelfModel
    config: Config
    world: SimulationLike | None
    maybe_real: bool
    feedforward: str
    duration_s: float
    played: Player | None

    def draw(self, arm: ArmInCell | None = None) -> Draw:
        """What draws a motion, one that keeps an arm's links clear where one is told."""
        if self.played is not None:
            return self.played
        if self.config.excitation.kind != DESIGNED:
            return RandomMotion
        designer = Designer(Information(self.robot, self.config.pipeline.filter))
        return designer if arm is None else designer.within(arm)

    def free_motion(self) -> FreeMotion:
        """What draws a motion that is free in the cell. Raises SettingsError, MeansError."""
        arm = ArmInCell(self.robot, self.config.cell)
        return FreeMotion(arm, self.duration_s + self.config.excitation.slow_s, self.draw(arm))

    def open(self, address: str, may_move: bool) -> Driver:
        """The driver of an address, not connected yet. Raises UsageError, ValueError."""
        scheme, _ = split_address(address)
        builders = {} if self.world is None else {scheme: self.world.driver}
        return open_driver(address, builders, self.robot.tree.joint_names, may_move)


def run_plan(args: argparse.Namespace) -> RunPlan:
    """Model, settings and simulated arm of a command line.

    Raises:
        UsageError, SettingsError, ModelError, ValueError: what is asked for does not exist.
    """
    robot = robot_of(args, args.robot)
    scheme, rest = split_address(args.driver)
    world = None
    if simulated(args.driver):
        optional.load("pybullet")
        builder = import_module(SIMULATED_BY)
        world = builder.simulation(args.driver, args.scenario, args.set, args.seed or 0)
    names = counted(robot, args.driver, joint_count(args.driver))
    if world is not None:
        names = tuple(world.scenario.truth.joint_names)
    elif scheme == "log":
        names = read_log(rest).joint_names
    robot, locked = present(robot, names, args.driver)
    terminal.warn(locked)
    config = with_motion(args, configure(args, None, robot))
    if world is not None and world.scenario.imus:
        pipeline = with_imus(config.pipeline, world.scenario.imus)
        config = dataclasses.replace(config, pipeline=pipeline)
    real = world is None and maybe_real(scheme)
    if real and _may_move(args):
        need_complete(robot)
        config = dataclasses.replace(config, excitation=gentle(config.excitation))
    motion, limits, played, duration_s = config.excitation, MotionLimits.of(robot), None, USUAL_S
    if args.motion is not None:
        played = Player(args.motion.name, *read_motion(args.motion, robot.tree.joint_names))
        duration_s = played.seconds(limits, motion)
    usual = "documented" if played is not None or motion.kind == DESIGNED else "none"
    forward, duration_s = args.feedforward or usual, args.duration or duration_s
    return RunPlan(config.apply(robot), config, world, real, forward, duration_s, played)


def _may_move(args: argparse.Namespace) -> bool:
    return bool(args.allow_motion and not args.passive)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    if not (args.no_record or args.overwrite):
        _check_free(args)
    plan = run_plan(args)
    config, robot = plan.config, plan.robot
    if plan.maybe_real and _may_move(args):
        need_somebody(args.yes)
    folder = terminal.results_folder(args.out, "run")
    truth = args.truth
    if truth is None and plan.world is not None:
        plan.world.scenario.write_truth(folder / "truth.json")
        # errors are against it where a scenario was asked for
        truth = folder / "truth.json" if plan.world.asked_for else None
    reference = reference_from(truth, robot)
    driver = plan.open(args.driver, _may_move(args))
    if args.fault is not None:
        driver = with_faults(driver, args.fault, args.seed or 0)
    if plan.maybe_real and not driver.can_move:
        if _may_move(args):
            terminal.warn(["--allow-motion changes nothing here: this driver only listens"])
        else:
            terminal.say("only listening; --allow-motion lets the arm move")
    compile_first(robot, config.pipeline, 1, terminal.say)
    front_end = make_front_end(robot, config.pipeline)
    result = _go(args, plan, driver, front_end, folder, truth)
    if isinstance(driver, FaultyDriver):
        terminal.show(driver.account.line())
    notes = [] if result.tracking is None else result.tracking["notes"]
    fault = [result.fault] if result.fault else []
    terminal.warn([*fault, *result.troubles, *result.intake.notes, *notes])
    if result.unrecorded:
        share = 100.0 * result.unrecorded / result.samples
        terminal.warn([f"{result.unrecorded} samples ({share:.2g} %) are not in the recording"])
    if result.collected is None:
        for line in _accounts(result):
            terminal.show(line)
        terminal.complain("the learner ended early")
        return ExitCode.LEARNER_FAILED
    _conclude(args, folder, plan, reference, front_end, result)
    if result.fault:
        return ExitCode.ARM_FAILED
    usual = ExitCode.INCOMPLETE if result.unrecorded else ExitCode.DONE
    return code_of(result.collected, usual)


def _accounts(result: LiveResult) -> list[str]:
    """How long things took, and what became of commands."""
    commands = result.intake.commands
    return result.timing.lines() + ([] if commands is None else [commands.line()])


def controller_of(
    args: argparse.Namespace, plan: RunPlan, driver: Driver
) -> ExcitationController | None:
    """What moves the arm; None where it is only listened to. Raises SettingsError, MeansError."""
    if args.passive or not driver.can_move:
        return None
    config, robot = plan.config, plan.robot
    forward: Feedforward | None = None
    expected = ModelFeedforward.of(robot)
    tool = None if robot.tool is None else robot.tool.theta()
    if plan.feedforward == "documented":
        forward = expected
    elif plan.feedforward == "learned":
        effects = config.pipeline.learner.effects
        known, gravity = not_learned(robot, effects), with_bodies(robot).gravity
        bound = FeedforwardBound(robot, expected)
        forward = LearnedFeedforward(robot.tree, gravity, effects, tool, known, bound)
    control = ControlSettings(safety=config.safety)
    limits = MotionLimits.of(robot)
    draw: Callable[..., PathMotion] = plan.draw()
    if plan.maybe_real:
        draw = free = plan.free_motion()
        free.arm.meanwhile = reading(driver)
    controller = ExcitationController(limits, config.excitation, control, forward, draw, expected)
    if plan.maybe_real and not (args.trust_model and driver.adds_gravity):
        controller.weight = CarriedWeight(robot, args.trust_model)
    return controller


def _go(
    args: argparse.Namespace,
    plan: RunPlan,
    driver: Driver,
    front_end: FrontEnd,
    folder: Path,
    truth: Path | None,
) -> LiveResult:
    """The live run itself; an arm that may be real shows its plan and has a dead man's switch."""
    config, robot, maybe_real = plan.config, plan.robot, plan.maybe_real
    controller = controller_of(args, plan, driver)
    duration_s = plan.duration_s + (config.excitation.slow_s if controller is not None else 0.0)
    recording = None if args.no_record else _recording(args, plan, driver, folder, truth)
    effects = config.pipeline.learner.effects
    known = KnownRun(robot, effects, args.driver, duration_s, secrets.token_hex(8))
    # without a terminal (a pipe, CI) there is no table, and who has something to say says it
    publisher = publisher_job(args.driver, robot, effects)
    display = None
    if terminal.console.is_terminal and not args.quiet:
        display = DisplayJob(partial(LiveTable, known), says=True)

    later: list[Callable[[], Path] | None] = []

    def before_motion(stopped: Callable[[], bool]) -> None:
        # who holds the arm, say; again with what came later at the end
        terminal.warn(driver.intake.notes)
        if controller is None:
            terminal.warn(filter(None, [another_robot(driver, MotionLimits.of(robot))]))
        elif maybe_real:
            later.append(agree(args, driver, controller, duration_s, folder, stopped))

    aloud = display is None and not args.quiet
    learner = learner_job(
        robot, config.pipeline, args.checkpoint, args.resume, aloud, args.trust_log
    )
    deadman = maybe_real and controller is not None
    safety, watching = config.safety, None
    if safety.watch_contacts or safety.stop_at_contact:
        observer = ContactObserver(robot, effects)
        names = robot.tree.joint_names
        watching = FollowingObserver(observer, safety.stop_at_contact, names)
        if controller is not None:
            controller.observer = observer
    jobs = Jobs(learner, recording, display, together([_view_job(args, known), publisher]))
    options = LiveOptions(duration_s, deadman, before_motion=before_motion, observer=watching)
    result = run_live(driver, front_end, controller, jobs, options, say=terminal.say)
    for write in filter(None, later):
        write()
    if watching is None:
        return result
    return dataclasses.replace(result, contacts=contacts_of(watching.observer, robot))


def _view_job(args: argparse.Namespace, known: KnownRun) -> DisplayJob | None:
    """The view process of a run, and a line for each address; None where nobody asked.

    Raises:
        UsageError: a port is taken. MeansError: Foxglove's library is missing.
    """
    listening: socket.socket | None = None
    port: int | None = None
    if args.foxglove is not None:
        need_foxglove()
        port = free_port(args.foxglove)
        terminal.say(f"Foxglove, PlotJuggler: ws://{HOST}:{port}")
    if args.view is not None:
        listening = bind(None if args.view == ANY else args.view)
        terminal.say(f"watch it: {address(listening)}")
    if listening is None and port is None:
        return None
    make = partial(make_view, known, listening, port)
    return DisplayJob(make, period_s=PERIOD_S, idle=True)


def _recording_path(args: argparse.Namespace, folder: Path) -> Path:
    return args.record or folder / "recording.mcap"


def _parts(path: Path) -> list[Path]:
    """Files of a recording that are there: itself, and those of recorders that went on with it."""
    name, kind = escape(path.stem), escape(path.suffix)
    return [*path.parent.glob(name + kind), *path.parent.glob(f"{name}.part*{kind}")]


def _check_free(args: argparse.Namespace) -> None:
    """Refuse a run over the recording of another, which nothing brings back. Raises UsageError."""
    there = [] if args.out is args.record is None else _parts(_recording_path(args, args.out))
    if there:
        raise UsageError(
            f"{there[0]}: is there, and a recording cannot be made again; give another --out "
            "FOLDER or --record FILE, --overwrite to replace it, or --no-record to keep none"
        )


def _recording(
    args: argparse.Namespace, plan: RunPlan, driver: Driver, folder: Path, truth: Path | None
) -> RecordingJob:
    """The recording, with all that a replay needs to repeat the run."""
    how = {"driver": args.driver, "scenario": args.scenario}
    how["commands_without_gravity"] = driver.adds_gravity
    metadata = recording_metadata(plan.config, plan.robot, shlex.join(sys.argv[1:]), **how)
    attachments = {"documented.json": dumps(plan.robot).encode()}
    if truth is not None:
        attachments["truth.json"] = truth.read_bytes()
    path = _recording_path(args, folder)
    for earlier in _parts(path):  # --overwrite, or it would have been refused
        earlier.unlink()
    return RecordingJob(path, metadata, attachments, arm=ShownArm.of(plan.robot))


def _conclude(
    args: argparse.Namespace,
    folder: Path,
    plan: RunPlan,
    reference: Any,
    front_end: FrontEnd,
    result: LiveResult,
) -> None:
    """Figures, files, headline."""
    robot, outcome = plan.robot, result.collected
    refused = dict(front_end.refused)
    lost = result.unlearned + result.passed_on - outcome.learned
    if lost:
        refused["not_reached_learner"] = lost
    taken = result.samples, refused, front_end.first_moving_ns, front_end.delay_s
    slow_s = 0.0 if result.tracking is None else plan.config.excitation.slow_s
    numbers = figures(
        outcome,
        robot,
        reference,
        Course(*taken, result.timing.tick_us, result.timing.missed_deadlines, slow_s),
        warnings=[
            *front_end.messages,
            *result.troubles,
            *outcome.lam_notes,
            *outcome.verdict.notes,
            *contact_lines(result.contacts, robot.tree.joint_names, front_end.start_s),
        ],
        start_s=front_end.start_s,
        contacts=result.contacts,
        robot=robot.name,
        driver=args.driver,
        recordings=[] if args.no_record else [_recording_path(args, folder)],
        scenario=args.scenario,
        program=f"panda-adapter {terminal.program_version()}",
        timing=result.timing.as_dict(),
        granted=result.grants,
        ended=result.ended,
        fault=result.fault,
        intake=result.intake.as_dict(),
        **{key: getattr(result, key) for key in AS_TOLD},
        feedforward=plan.feedforward,
    )
    learned = Learned(outcome, robot, reference, front_end, _accounts(result))
    conclude(args, folder, learned, numbers, args.driver)
