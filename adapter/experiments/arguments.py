"""The command lines of `adapter experiment` and `adapter bench`; brings nothing heavy."""

from __future__ import annotations

import argparse
import math
from importlib import import_module
from pathlib import Path

from adapter.errors import UsageError
from adapter.runs.terminal import check_writable

EXPERIMENTS = ("atlas", "panda")
SPLIT = "adapter.experiments.falls"  # brings NumPy; loaded by name where it is used
LEAST_LEARNED = 50  # samples; far fewer show λ and θ of 30 joints only by chance


def experiment(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `experiment`."""
    parser.description = (
        "Rerun section IV of the paper: `atlas`, a simulated humanoid in free fall "
        "against three learners that know no physics, and `panda`, online learning at 1 kHz. "
        "Prints the paper's figures beside ours and makes one HTML page."
    )
    add = parser.add_argument
    add("names", nargs="+", choices=EXPERIMENTS, metavar="NAME", help="which: atlas, panda")
    add("--full", action="store_true", help="the baselines in the paper's size")
    add("--no-baselines", action="store_true", help="atlas: only the FOP networks")
    add("--trajectories", type=int, default=63, metavar="N", help="atlas: default 63")
    add("--seconds", type=float, default=10.0, metavar="S", help="atlas: of each; default 10")
    said = "recordings whose tree is to be found, N and A unknown; default 20"
    add("--seeds", type=int, default=20, metavar="N", help=said)
    add("--seed", type=int, default=0, help="of every random choice")
    add("--cache", type=Path, metavar="FOLDER", help="where simulated data are kept")
    add("--out", type=Path, metavar="FOLDER", help="where results go")
    add("--json", type=Path, metavar="FILE", help="write the figures")
    parser.set_defaults(check=_check_experiment)


def _check_experiment(args: argparse.Namespace) -> None:
    """Before minutes of work. Raises UsageError or OSError for what would end it."""
    if args.seed < 0 or args.seeds < 0:
        raise UsageError("--seed and --seeds must be 0 or more")
    if "atlas" in args.names:
        split, count, seconds = import_module(SPLIT), args.trajectories, args.seconds
        if count < split.LEAST_TRAJECTORIES:
            raise UsageError(f"--trajectories must be at least {split.LEAST_TRAJECTORIES}")
        if not 0.0 < seconds < math.inf:
            raise UsageError(f"--seconds must be above 0 and finite, got {seconds}")
        learned = split.learned_samples(count, round(1000.0 * seconds))
        if learned < LEAST_LEARNED:  # too little to learn from
            raise UsageError(
                f"{count} falls of {seconds:g} s give {learned} samples to learn from (1 % of the "
                f"training set), fewer than {LEAST_LEARNED}; raise --trajectories or --seconds"
            )
    check_writable(args.json)


def bench(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `bench`."""
    parser.description = (
        "Times one update of λ and θ of a Panda beside autograd through the torch networks and "
        "Pinocchio's regressor with recursive least squares (if pin is installed). With --log it "
        "compares ways to learn that arm instead, each told the documented model and the recording "
        "and run in a process of its own: adapter gap and replay, least squares, and, where extra "
        "[peers] is installed, figaroh, mujoco.sysid and CMA-ES: unseen torque, rollouts, time, "
        "memory."
    )
    add = parser.add_argument
    add("--repeats", type=int, default=2000, metavar="N", help="default 2000")
    add("--log", type=Path, metavar="LOG", help="recording of an arm to compare ways to learn on")
    add("--hold-out", type=Path, metavar="LOG", help="judge on this one, learn from all of --log")
    add("--robot", default="panda", metavar="NAME|FILE", help="the arm as documented")
    said = "learn before this second of LOG, judge after it (default: two thirds)"
    add("--validate-from", type=float, metavar="S", help=said)
    add("--only", nargs="+", metavar="WAY", help="of --log these ways, by the names in its table")
    said = "iterations of mujoco.sysid; CMA-ES has ten times as many (default 20)"
    add("--rounds", type=int, default=20, metavar="N", help=said)
    add("--limit", type=float, default=1800.0, metavar="S", help="for each way (default 1800)")
    add("--out", type=Path, metavar="FOLDER", help="where results go")
    add("--json", type=Path, metavar="FILE", help="write the figures")
    parser.set_defaults(check=_check_bench)


def _check_bench(args: argparse.Namespace) -> None:
    """Raises UsageError or OSError for what would end it minutes later."""
    for path in (args.log, args.hold_out):
        if path is not None and not path.exists():
            raise UsageError(f"{path}: no such recording")
    if args.hold_out is not None and (args.log is None or args.validate_from is not None):
        raise UsageError("--hold-out goes with --log, and without --validate-from")
    check_writable(args.json)
