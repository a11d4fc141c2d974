"""`adapter excite`: a motion that teaches most, or that tells effects apart; nothing moves."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from adapter.cli.agreement import PLAN_PAGE
from adapter.cli.common import robot_of, with_motion
from adapter.cli.exit_codes import ExitCode
from adapter.control.designed import DesignedMotion, Designer
from adapter.control.excitation import RandomMotion
from adapter.control.free_path import ArmInCell, FreeMotion
from adapter.control.information import Expected, Information
from adapter.control.limits import MotionLimits, need_complete
from adapter.control.settings import ExcitationSettings
from adapter.control.sweeps import MOVES, SweepMotion
from adapter.effects.phrases import DecidingExperiment
from adapter.errors import SettingsError
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.report.next_steps import Step, command
from adapter.report.plan_page import Plan
from adapter.runs.config import read_config
from adapter.runs.library import filtered
from adapter.runs.terminal import results_folder, say, show
from drivers.files.bounded import parse_json, read_text
from drivers.files.mcap.writer import McapWriter, to_json

TABLE, COMPARED = 300, 3  # instants of a path that are judged, random motions beside
TENTH = 0.1  # of a period, between two durations that are looked at


@dataclass(frozen=True)
class Known:
    """What logs tell already.

    Attributes:
        information: (rank, rank); None without logs.
        torque_std: (n,) N m, what is left of their torques; None without logs.
        start: (n,) rad, where the first one starts; None without logs.
    """

    information: Array | None = None
    torque_std: Array | None = None
    start: Array | None = None


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    robot = robot_of(args, args.robot)
    config = with_motion(args, read_config(args.config))
    config = replace(config, gravity=args.gravity or config.gravity)
    robot, settings = config.apply(robot), config.excitation
    if args.seed is not None:
        settings = replace(settings, seed=args.seed)
    need_complete(robot)
    limits, arm = MotionLimits.of(robot), ArmInCell(robot, config.cell)
    std = _of_joints("--noise", args.noise, robot)
    told = Information(robot, config.pipeline.filter, torque_std=std)
    tables = [_table(path, robot, told) for path in args.logs]
    known = _known(tables, told) if tables else Known()
    if std is None and known.torque_std is not None:
        told = Information(robot, config.pipeline.filter, torque_std=known.torque_std)
        known = _known(tables, told)
    q0 = _start(args, arm, limits, known)
    folder = results_folder(args.out, "excite")
    if args.gap is not None:
        todo = _measured_next(args.gap, arm.model)
        length_s = _sweeps(todo, limits, q0, settings).length_s
        swept = FreeMotion(arm, length_s, partial(_sweeps, todo))(limits, q0, settings)
        assert isinstance(swept, SweepMotion)
        plan = Plan(arm, swept, limits, arm.clearance(swept, swept.length_s))
        _write(args, folder, plan, swept.length_s)
        return ExitCode.DONE
    designer = Designer(told, known.information).within(arm)
    designed = FreeMotion(arm, designer.seconds, designer)(limits, q0, settings)
    assert isinstance(designed, DesignedMotion)
    seconds, expected = _until(told, known, designed, args)
    said = _told(told, known, designed, limits, seconds, expected)
    for line in said:
        show(line)
    plan = Plan(arm, designed, limits, arm.clearance(designed, seconds))
    _write(args, folder, plan, seconds, said)
    if args.json is not None:
        args.json.write_text(to_json(_figures(told, designed, seconds, expected)))
    return ExitCode.DONE


def _start(args: argparse.Namespace, arm: ArmInCell, limits: MotionLimits, known: Known) -> Array:
    """Where the motion starts, (n,) rad. Raises SettingsError where it is not free there."""
    q0 = _of_joints("--at", args.at, arm.model)
    if q0 is None:
        q0 = known.start if known.start is not None else 0.5 * (limits.lower + limits.upper)
    nearest, margin = arm.at(q0), arm.cell.margin
    if nearest.distance < margin:
        at = ", ".join(f"{angle:.2f}" for angle in q0)
        raise SettingsError(
            f"no motion can start at {at} rad: {nearest}, where {margin:g} m are kept; give --at, "
            "or describe the cell in --config ([cell])"
        )
    return q0


def _of_joints(option: str, values: Sequence[float], robot: SelfModel) -> Array | None:
    if len(values) not in (0, robot.tree.n):
        raise SettingsError(f"{option} needs {robot.tree.n} finite numbers, got {len(values)}")
    return np.array(values) if values else None


def _table(path: Path, robot: SelfModel, told: Information) -> tuple[Array, Array, Array, Array]:
    """q, dq, ddq, tau (m, n) of a log, as many as are independent. Raises SettingsError."""
    signals = filtered(path, robot)
    if not len(signals.q):
        raise SettingsError(f"{path}: nothing in it can be learned from")
    every = max(1, round(len(signals.q) / max(1.0, signals.time_s[-1] * told.samples_per_s)))
    q, dq, ddq, tau = (np.ascontiguousarray(x[::every]) for x in signals[1:])
    return q, dq, ddq, tau


def _known(tables: Sequence[tuple[Array, Array, Array, Array]], told: Information) -> Known:
    """Of several logs the information adds up; the torque's noise is what no parameters explain."""
    total, start = np.zeros_like(told.prior), tables[0][0][0]
    left, count = np.zeros(len(start)), 0
    for q, dq, ddq, tau in tables:
        total += len(q) * told.mean(q, dq, ddq)
        Y = told.regressor(q, dq, ddq)
        x = np.linalg.lstsq(Y.reshape(-1, Y.shape[2]) @ told.basis, tau.ravel(), rcond=None)[0]
        left += ((tau - Y @ (told.basis @ x)) ** 2).sum(axis=0)
        count += len(q)
    return Known(total, np.sqrt(left / count), start)


def _until(
    told: Information, known: Known, motion: DesignedMotion, args: argparse.Namespace
) -> tuple[float, Expected]:
    """How long it takes, s of path, and what is known then; `--longest` where it is not enough."""
    tenth, instants, size = TENTH * motion.period_s, motion.table(TABLE), round(TABLE * TENTH)
    brought = known.information if known.information is not None else np.zeros_like(told.prior)
    for k in count(1):
        part = np.arange((k - 1) * size, k * size) % TABLE
        H = told.mean(*(signal[part] for signal in instants))
        brought = brought + tenth * told.samples_per_s * H
        expected = told.expected(brought, args.std)
        enough = expected.worst <= 1.0 and k * TENTH >= 1.0
        if enough or (k + 1) * tenth > args.longest:
            break
    return k * tenth, expected


def _told(
    told: Information,
    known: Known,
    motion: DesignedMotion,
    limits: MotionLimits,
    seconds: float,
    expected: Expected,
) -> list[str]:
    """What the motion teaches, beside random motion."""
    before = known.information if known.information is not None else np.zeros_like(told.prior)
    drawn = []
    for attempt in range(COMPARED):
        other = RandomMotion(limits, motion.q, motion.settings, attempt)
        path = np.array([other.path(s).copy() for s in np.linspace(0.0, seconds, TABLE)])
        table = tuple(path[:, k].copy() for k in range(3))
        H = before + seconds * told.samples_per_s * told.mean(*table)
        worst = told.expected(H, 1.0).std / expected.std
        drawn.append((float(np.median(worst[expected.shown])), told.condition(*table)))
    wide, condition = np.median(np.array(drawn), axis=0)
    reached = "is" if expected.worst <= 1.0 else f"is not (worst: {expected.worst:.2g} times that)"
    shown = int(expected.shown.sum())
    lines = [
        f"After {seconds:.0f} s each of the {shown} parameters that torques show {reached} as "
        "sure as wanted.",
        f"Random motion leaves them {wide:.1f} times as unsure (median); the condition number of "
        f"the base parameters' regressor is {told.condition(*motion.table(TABLE)):.0f}, random "
        f"motion's {condition:.0f}.",
    ]
    ratio = np.where(expected.shown, expected.std / expected.wanted, 0.0)
    for k in np.argsort(-ratio)[:8]:  # parameters that are shown
        std, unit = expected.std[k], expected.units[k]
        lines.append(f"  {expected.names[k]:28} +- {std:.2g} {unit} ({ratio[k]:.0%} of the wanted)")
    return lines


def _figures(
    told: Information, motion: DesignedMotion, seconds: float, expected: Expected
) -> dict[str, Any]:
    numbers = (expected.std.tolist(), expected.wanted.tolist(), expected.shown.tolist())
    rows = zip(expected.names, expected.units, *numbers, strict=True)
    keys = ("name", "unit", "std", "wanted", "shown")
    return {
        "seconds": seconds,
        "period_s": motion.period_s,
        "condition": told.condition(*motion.table(TABLE)),
        "parameters": [dict(zip(keys, row, strict=True)) for row in rows],
    }


def _measured_next(path: Path, robot: SelfModel) -> list[tuple[int, DecidingExperiment]]:
    """The experiments of a gap report that a motion can make, by joint. Raises SettingsError."""
    try:
        report = parse_json(read_text(path))
        findings = [(str(f["split_by"]), list(f["joints"])) for f in report["findings"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SettingsError(f"{path}: not the JSON of `adapter gap`: {error}") from None
    found: dict[tuple[int, DecidingExperiment], None] = {}
    for text, joints in findings:
        for experiment in MOVES:
            if experiment.do in text:
                found.update({(int(j) - 1, experiment): None for j in joints})
    wanted = [(j, e) for j, e in found if 0 <= j < robot.tree.n]
    others = {text.partition(":")[0] for text, _ in findings if text}
    others -= {experiment.do for _, experiment in wanted}
    for text in sorted(others):
        say(f"No motion alone does this: {text}.")
    if not wanted:
        said = "no experiment that a motion can make is asked for; design one that teaches all"
        raise SettingsError(f"{path}: {said} (without --gap)")
    for j, experiment in wanted:
        show(f"{robot.tree.joint_names[j]}: {experiment.do}")
    return wanted


def _sweeps(
    todo: list[tuple[int, DecidingExperiment]],
    limits: MotionLimits,
    q0: Array,
    settings: ExcitationSettings,
    attempt: int = 0,
    size: float = 1.0,
) -> SweepMotion:
    return SweepMotion(limits, q0, settings, todo, size)


def _write(
    args: argparse.Namespace, folder: Path, plan: Plan, seconds: float, said: Sequence[str] = ()
) -> None:
    """The page and both files of a motion from its start to rest, and what is said of it."""
    motion, names = plan.motion, plan.arm.model.tree.joint_names
    lines = plan.lines(seconds)
    step_ns = round(1e9 / args.rate)
    rows = [np.array([motion.q, motion.dq, motion.ddq])]
    while not motion.at_rest:
        if motion.time_s >= seconds:
            motion.begin_stop()
        motion.advance(1e-9 * step_ns)
        rows.append(np.array([motion.q, motion.dq, motion.ddq]))
    times_ns, points = step_ns * np.arange(len(rows), dtype=np.int64), np.array(rows)
    with (folder / "motion.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        heads = [f"{kind}_{name}" for kind in ("q", "dq", "ddq") for name in names]
        writer.writerow(["time_s", *heads])
        for since_ns, point in zip(times_ns, points, strict=True):
            writer.writerow([f"{1e-9 * since_ns:.6f}", *(f"{x:.9g}" for x in point.ravel())])
    recording = McapWriter(folder / "motion.mcap", names, overwrite=True)
    recording.write_trajectory(times_ns, points)
    recording.close()
    for line in lines:
        show(line)
    show(f"{len(points)} points at {args.rate:g} Hz: {folder / 'motion.csv'}, motion.mcap")
    worst = ["Least sure: " + "; ".join(" ".join(x.split()) for x in said[2:])] if said else []
    robot = [] if args.robot is None else ["--robot", args.robot]
    step = Step("Play it", command("run", "--motion", folder / "motion.csv", *robot))
    show(f"next: {step.why}: {step.command}")
    say(f"As a page: {plan.write(folder / PLAN_PAGE, [*said[:2], *worst, *lines], [step])}")
