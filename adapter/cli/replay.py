"""`adapter replay`: learn from a recording."""

from __future__ import annotations

import argparse
import tempfile
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress

from adapter.cli.common import UsageError, add_learning_options, configure, console, robot_of, warn
from adapter.cli.results import conclude, results_folder
from adapter.config import REAL_ARM_EFFECTS, Config
from adapter.errors import SettingsError
from adapter.filters import noise_from_samples
from adapter.matching import matching
from adapter.model import SelfModel
from adapter.outcome import learned_model
from adapter.replay import Replay, seconds
from adapter.replay import replay as learn_from
from adapter.score import figures, reference_from
from adapter.torque import ModelTorque
from adapter.validation import validation_torque_rmse
from drivers.mcap_file import Log, read_log

FEWEST_FOR_NOISE = 50  # samples
PERCENTILES = {"p50": 50.0, "p99": 99.0, "p99.9": 99.9, "max": 100.0}


def add_parser(commands: Any) -> None:
    """Declare the subcommand."""
    parser = commands.add_parser(
        "replay",
        help="learn from a recording",
        description="Learn λ and θ from an MCAP recording, sample by sample as the live process "
        "does (the result is the same), or in batches.",
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="MCAP recording, ours or not")
    add_learning_options(parser)
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="one update per N samples (batch)"
    )
    held_out = parser.add_mutually_exclusive_group()
    held_out.add_argument("--validate", type=Path, metavar="LOG", help="score on this recording")
    held_out.add_argument(
        "--validate-from", type=float, metavar="S", help="learn before this second, score after it"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    if args.every > 1 and args.mode == "sample":
        raise UsageError("--every needs mode moments; have: --mode moments, or --every 1")
    whole = read_log(args.log)
    recorded = whole.metadata.get("config")
    robot = _robot(args, whole)
    recorded = recorded if isinstance(recorded, dict) else None
    config = configure(args, recorded, REAL_ARM_EFFECTS, robot)
    robot = config.apply(robot)
    reference = reference_from(args.truth, robot)
    log = matching(whole, robot)
    warn(log.warnings)
    config = fitting(log, config)
    result = _learn(args, log, robot, config)
    front_end = result.pipeline.front_end
    numbers = figures(
        result.outcome,
        robot,
        reference,
        samples=result.samples,
        refused=front_end.refused,
        first_moving_ns=front_end.first_moving_ns,
        tick_us=_percentiles(result),
        missed_deadlines=0,
        delay_s=front_end.delay_s,
        warnings=[*log.warnings, *front_end.messages],
        recording=str(args.log),
        robot=robot.name,
        every=args.every,
        times_real_time=result.span_s / max(result.wall_s, 1e-9),
        noise=noise_levels(log) if len(log) >= FEWEST_FOR_NOISE else None,
        gaps=[{"after_s": 1e-9 * stamp, "length_s": length} for stamp, length in front_end.gaps],
    )
    if front_end.first_moving_ns is None:
        warn([f"{args.log}: the arm never moves (no |dq| above 0.02 rad/s); nothing is learned"])
    held_out = _held_out(args, log, robot)
    if held_out is not None:
        numbers["theta"]["validation_torque_rmse_nm"] = validation_torque_rmse(
            *held_out, ModelTorque(learned_model(result.outcome, robot))
        ).tolist()
    folder = results_folder(args, "replay")
    conclude(args, folder, result.outcome, robot, reference, numbers, front_end, str(args.log))
    console.print(f"{result.span_s / max(result.wall_s, 1e-9):.1f} times faster than real time")
    return 0


def fitting(log: Log, config: Config) -> Config:
    """The filter settings for the rate of a recording and, where they leave it open, its noise."""
    settings = config.pipeline.filter
    steps = np.diff(log.stamp_ns)
    steps = steps[steps > 0]
    changes: dict[str, float] = {}
    if len(steps):
        period_s = 1e-9 * float(np.median(steps))
        if not 0.8 < period_s / settings.period_s < 1.25:
            changes["period_s"] = period_s
            warn([f"{log.path}: {1.0 / period_s:.0f} samples a second; the filter follows"])
    open_noise = settings.dq_noise is None and settings.dq_drive is not None
    if open_noise and len(log) >= FEWEST_FOR_NOISE:
        changes["dq_noise"] = float(np.median(noise_levels(log)["dq"]))
    changed = replace(settings, **changes)
    return replace(config, pipeline=replace(config.pipeline, filter=changed))


def noise_levels(log: Log) -> dict[str, np.ndarray]:
    """White-noise level (n,) of q, dq and tau of a recording, from its high frequencies."""
    new = np.ones(len(log), dtype=bool)
    new[1:] = (np.diff(log.dq, axis=0) != 0).any(axis=1)
    return {
        name: noise_from_samples(np.nan_to_num(getattr(log, name)[new]))
        for name in ("q", "dq", "tau")
    }


def _robot(args: argparse.Namespace, log: Log) -> SelfModel:
    """The robot asked for, else the one that the recording carries, else the Panda."""
    carried = log.attachments.get("documented.json")
    if args.robot is not None or carried is None:
        return robot_of(args.robot)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "documented.json"
        path.write_bytes(carried)
        return SelfModel.load(path)


def _learn(args: argparse.Namespace, log: Log, robot: SelfModel, config: Config) -> Replay:
    if args.validate_from is not None and not 0.0 < args.validate_from < seconds(log)[-1]:
        raise SettingsError(
            f"--validate-from {args.validate_from} is outside the recording "
            f"(0 to {seconds(log)[-1]:.1f} s)"
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
            every=args.every,
            until_s=args.validate_from,
            progress=progress,
            resume=args.resume,
            say=None if args.quiet else tell,
        )


def tell(line: str) -> None:
    """A new disagreement, when it is found."""
    console.print(f"[yellow]new disagreement:[/] {line}", soft_wrap=True)


def _held_out(
    args: argparse.Namespace, log: Log, robot: SelfModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """(seconds, q, dq, tau) to score on, or None."""
    if args.validate_from is not None:
        late = seconds(log) >= args.validate_from
        return seconds(log)[late], log.q[late], log.dq[late], log.tau[late]
    if args.validate is not None:
        other = matching(read_log(args.validate), robot)
        return seconds(other), other.q, other.dq, other.tau
    return None


def _percentiles(result: Replay) -> dict[str, float | None]:
    if not len(result.tick_ns):
        return dict.fromkeys(PERCENTILES)
    us = 1e-3 * result.tick_ns
    return {name: float(np.percentile(us, share)) for name, share in PERCENTILES.items()}
