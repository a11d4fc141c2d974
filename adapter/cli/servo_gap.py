"""`adapter gap` on recordings of a position-controlled arm: commands and encoders, no torque."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path

from rich.text import Text

from adapter.cli.common import robot_of
from adapter.cli.exit_codes import ExitCode
from adapter.errors import UsageError
from adapter.gap.servo import explain
from adapter.gap.servo_model import read_servos
from adapter.gap.servo_words import as_json, lines
from adapter.runs.compiling import announce_compiling
from adapter.runs.terminal import complain, console, output, results_folder, say, write_json
from adapter.screening.screen import RecordingRefused
from drivers.files.mcap import Log, read_position_log

WITH_TORQUE = (  # options
    *("validate_from", "rounds", "turn_or_zero", "tau", "trust_log"),
    *("tau_gain", "gear", "known_load"),
)


def position_logs(args: argparse.Namespace) -> tuple[list[Log], list[Log]] | None:
    """The recordings and those held out; None where they are not of such an arm.

    Raises:
        DriverError: a file is unreadable. UsageError: some have torques and others have not.
    """
    paths = [*args.logs, *args.hold_out]
    read = {path: read_position_log(path, args.topic) for path in dict.fromkeys(paths)}
    without = [path for path, log in read.items() if log is None]
    if len(without) == len(read):
        if args.servo is not None:
            raise UsageError(
                f"--servo: {without[0]} holds no position commands beside positions without "
                "efforts (/joint_commands and /joint_states)"
            )
        return None
    if without:
        raise UsageError(
            f"{', '.join(map(str, without))}: not commands and positions alone, as the others are; "
            "give recordings of one kind"
        )
    found = {path: log for path, log in read.items() if log is not None}
    return [found[path] for path in args.logs], [found[path] for path in args.hold_out]


def run(args: argparse.Namespace, logs: list[Log], hold_out: list[Log]) -> int:
    """Carry it out; returns the exit code."""
    unusable = [name for name in WITH_TORQUE if getattr(args, name)]
    if unusable:
        options = ", ".join("--" + name.replace("_", "-") for name in unusable)
        raise UsageError(f"{options}: for recordings with torques; these have commands alone")
    model = robot_of(args, args.model)
    names = model.tree.joint_names
    documented = None if args.servo is None else read_servos(args.servo, names)
    announce_compiling(say)
    folder = results_folder(args.out, "gap")
    target = folder / "servo.toml"
    if args.servo is not None and target.exists() and target.samefile(args.servo):
        raise UsageError(f"--out {folder} would overwrite {args.servo}; give another folder")
    more = {} if args.inertia_prior is None else {"inertia_prior": args.inertia_prior}
    try:
        with nullcontext() if args.quiet else console.status("starting") as status:
            tell = (lambda text: None) if status is None else (lambda t: status.update(Text(t)))
            gap = explain(logs, model, documented, hold_out, progress=tell, **more)
    except RecordingRefused as refusal:
        untold = {"headline": str(refusal), "problem": str(refusal), "findings": []}
        _write(args, folder, untold)
        complain(refusal)
        return ExitCode.DONE if refusal.kind.is_an_answer else ExitCode.WRONG_USE
    gap.servos.save(target)
    _write(args, folder, {**as_json(gap), "servos_out": str(target)})
    for line in lines(gap):
        output.print(Text.from_markup(line), soft_wrap=True)
    say(f"servos {target}")
    return 0


def _write(args: argparse.Namespace, folder: Path, figures: Mapping[str, object]) -> None:
    write_json(folder / "gap.json", figures)
    write_json(args.json, figures)
