"""Options that several commands share, and what is wrong with them at first sight.

Nothing here brings a library that takes long to load: wrong use is answered at once. The same
holds of every `..._options` beside a command's file.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from adapter.errors import UsageError
from adapter.model import ROBOT_FILES, robot_names
from drivers.errors import choices
from drivers.files.names import RECORDINGS, is_recording

MODES = ("moments", "sample")  # of `adapter.learning.learner`
NAMES = "adapter.cli.names"  # brings NumPy; loaded by name where there is a name to look up


def declaring(
    parser: argparse.ArgumentParser, words: Mapping[str, str]
) -> Callable[..., argparse.Action]:
    """What declares an option, as `add_argument`; its help is among these words, or given."""

    def add(option: str, **how: Any) -> argparse.Action:
        return parser.add_argument(option, **{"help": words.get(option), **how})

    return add


def add_learning(parser: argparse.ArgumentParser) -> None:
    """Options of everything that learns."""
    add = parser.add_argument
    add_robot(parser, "panda; of a recording its own")
    add("--config", type=Path, metavar="FILE", help="settings in TOML")
    add("--mode", choices=MODES, help="moments (default) or the paper's sample")
    add(
        "--effects",
        metavar="LIST|FILE",
        help="effects learned beside θ: none, real, or names with commas between (a name that "
        "does not exist lists them), a file of kept laws (.toml) among them",
    )
    add("--seed", type=int, help="of every random choice")
    add("--truth", type=Path, metavar="FILE", help="model or truth to compare with")
    add_results(parser)
    add("--resume", type=Path, metavar="FILE", help="go on from a checkpoint")


class _OtherWord(argparse.Action):
    """Takes --model where it can only be --robot, and says so."""

    def __call__(
        self, parser: argparse.ArgumentParser, where: argparse.Namespace, value: Any, said: Any = ""
    ) -> None:
        print(f"{said} is --robot here: the arm as documented", file=sys.stderr)
        setattr(where, self.dest, value)


def add_robot(parser: argparse.ArgumentParser, default: str = "panda", dest: str = "robot") -> None:
    """Which arm, as documented, what is taken where nobody says, and how it is mounted."""
    said = f"the arm as documented: panda, fr3, .urdf, .xml (MJCF), .json; default: {default}"
    kinds = "NAME|FILE"
    parser.add_argument("--robot", dest=dest, metavar=kinds, help=said.removesuffix("; default: "))
    parser.add_argument("--model", dest=dest, action=_OtherWord, help=argparse.SUPPRESS)
    add_joints(parser)


def need_robot(name: str | None) -> None:
    """Refuse that nobody says which arm recordings are held against. Raises UsageError."""
    if name is None:
        raise UsageError(f"missing: --robot; have: {', '.join([*robot_names(), *ROBOT_FILES])}")
    check_robot(name)


def add_joints(parser: argparse.ArgumentParser) -> None:
    """How the arm is mounted, and which of the model's joints move.

    Those that a recording lacks are locked at zero.
    """
    add = parser.add_argument
    said = "joints of the model that move; the others are locked"
    add("--joints", type=names_in, metavar="A,B,C", help=said)
    add(
        "--lock",
        action="append",
        default=[],
        type=_joint_value,
        metavar="JOINT=VALUE",
        help="lock a joint at a value, rad or m (default: zero where a recording lacks it)",
    )
    add(
        "--gravity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="in base axes, m/s², of an arm that does not stand upright: on a wall 9.81 0 0",
    )


def _joint_value(text: str) -> tuple[str, float]:
    """A joint and its value. Raises ArgumentTypeError."""
    name, _, value = text.rpartition("=")
    with suppress(ValueError):
        if name.strip() and math.isfinite(float(value)):
            return name.strip(), float(value)
    raise argparse.ArgumentTypeError(f"'{text}' is not JOINT=VALUE, a number in rad or m")


def add_motion(parser: argparse.ArgumentParser) -> None:
    """What limits a motion."""
    add = parser.add_argument
    add("--speed", type=float, metavar="SHARE", help="of the joints' speed limits, at most")
    add("--range", type=float, metavar="SHARE", help="of the joints' ranges, at most")
    said = "joints that move; the others stand still"
    add("--move", type=names_in, metavar="A,B,C", help=said)


def names_in(text: str) -> tuple[str, ...]:
    """Names with commas between."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def add_results(parser: argparse.ArgumentParser) -> None:
    """Where results go."""
    add = parser.add_argument
    add_json(parser)
    add("--out", type=Path, metavar="FOLDER", help="where results go")
    add("--no-report", action="store_true", help="do not write the HTML page")
    add("--quiet", action="store_true", help="no progress")


def add_json(parser: argparse.ArgumentParser, or_output: bool = False) -> None:
    """Where figures go; of some commands to the standard output, too."""
    metavar, more = ("FILE|-", "; - to the standard output") if or_output else ("FILE", "")
    parser.add_argument("--json", type=Path, metavar=metavar, help=f"write the figures{more}")


def check_learning(args: argparse.Namespace) -> None:
    """What is wrong with options of everything that learns. Raises UsageError, SettingsError."""
    check_robot(args.robot)
    check_files(args.config, args.truth, args.resume)
    if args.effects is not None or args.config is not None:
        import_module(NAMES).check_learning(args)


def check_robot(*names: str | None) -> None:
    """Refuse what is neither a known robot nor a file of one. Raises UsageError."""
    for name in names:
        if name is None or name in robot_names() or (Path(name) / "model.json").is_file():
            continue
        if Path(name).suffix.lower() == ".xacro":
            urdf = f"{name.removesuffix('.xacro').removesuffix('.urdf')}.urdf"
            raise UsageError(f"{name}: is xacro; make a URDF of it: xacro {name} > {urdf}")
        if Path(name).suffix.lower() not in (".urdf", ".xml", ".json"):
            raise UsageError(f"no robot '{name}'; {choices(name, robot_names(), ROBOT_FILES)}")
        check_files(Path(name))


def add_topic(parser: argparse.ArgumentParser) -> None:
    """Which topic of a bag tells the joints."""
    said = "of the joint states, where a bag has several"
    parser.add_argument("--topic", metavar="NAME", help=said)


TOLD_WORDS = {
    "--turn": "joints that LOG counts the other way: q, dq and tau get the other sign",
    "--zero": "what LOG tells where the model's joint is at zero, once turned by a --turn before",
    "--tau": "the controller took the arm's gravity off the efforts: the model's is added "
    "(--gravity 0 0 0: also that of the load)",
    "--trust-log": "joints and efforts are as the model has them: what speaks against it is a "
    "warning",
    "--tau-gain": "N m per recorded unit (motor current: N m/A), one per joint of the model or "
    "one for all, negative where the sign is wrong; those of several multiply; fit: learn them "
    "beside θ against the documented masses",
    "--gear": "efforts are of the motors: turns of the motor per turn of the link, one per joint "
    "or one for all; velocities and positions are of the links",
    "--known-load": "mass of a body that the hand carries in the recordings of --loaded "
    "(default: in all LOGs), so that --tau-gain fit knows the gains' scale",
    "--loaded": "with the known load, among the LOGs or beside them for the gains alone",
}


def add_told(parser: argparse.ArgumentParser) -> None:
    """How recordings tell joints and efforts, where it is not as the model has them."""
    add = declaring(parser, TOLD_WORDS)
    add(
        "--turn",
        dest="turn_or_zero",
        action="extend",
        default=[],
        type=lambda text: [(name, -1.0, 0.0) for name in names_in(text)],  # as `Told.joints`
        metavar="JOINT,...",
    )
    add(
        "--zero",
        dest="turn_or_zero",
        action="extend",
        type=lambda text: [(name, 1.0, rad) for name, rad in map(_joint_value, text.split(","))],
        metavar="JOINT=RAD,...",
    )
    add("--tau", choices=("gravity-compensated",))
    add("--trust-log", action="store_true")
    add("--tau-gain", action="append", metavar="G1,G2,...|fit")
    add("--gear", metavar="G1,G2,...")
    add("--known-load", type=float, metavar="KG")
    add("--loaded", nargs="+", action="extend", default=[], type=Path, metavar="LOG")


def check_told(args: argparse.Namespace) -> None:
    """Refuse what is no number and what goes with another option. Raises UsageError."""
    learn = args.learn_gains = args.tau_gain == ["fit"]
    args.gain = () if learn else _product(args.tau_gain or ())
    args.gears = numbers("--gear", args.gear)
    args.loaded = check_logs(*args.loaded)
    if args.loaded and args.known_load is None:
        raise UsageError("--loaded names recordings of the known load; give its --known-load KG")
    if args.known_load is not None and not learn:
        raise UsageError("--known-load fixes the scale of learned gains; give --tau-gain fit too")
    if args.known_load is not None and not 0.0 < args.known_load < math.inf:
        raise UsageError(f"--known-load takes a mass above zero in kg, got {args.known_load}")


def _product(texts: Sequence[str]) -> tuple[float, ...]:
    """Of several `--tau-gain`, joint by joint. Raises UsageError."""
    gains = [numbers("--tau-gain", text, "fit") for text in texts]
    count = max(map(len, gains), default=0)
    if not {len(gain) for gain in gains} <= {1, count}:
        raise UsageError("--tau-gain: one number for all joints or one for each")
    return tuple(math.prod(gain[j % len(gain)] for gain in gains) for j in range(count))


def numbers(
    option: str, text: str | None, *words: str, what: str = "numbers other than zero"
) -> tuple[float, ...]:
    """Numbers with commas between; none where nothing is given. Raises UsageError."""
    with suppress(ValueError):
        values = tuple(float(word) for word in ([] if text is None else text.split(",")))
        if all(math.isfinite(x) and (what == "numbers" or x != 0.0) for x in values):
            return values
    choices = " or ".join((f"{what}, with commas between", *words))
    raise UsageError(f"{option} '{text}': takes {choices}")


def check_logs(*paths: Path | None) -> list[Path]:
    """Recordings, and of folders that are no rosbag2 the recordings in them, in order of names.

    Raises:
        UsageError: one cannot be read, or a folder has none.
    """
    found: list[Path] = []
    for path in (path for path in paths if path is not None):
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            inside = sorted(p for p in path.iterdir() if is_recording(p))
            if not inside:
                raise UsageError(f"{path}: no recording in this folder ({', '.join(RECORDINGS)})")
            found += inside
        else:
            found.append(path)
    check_files(*(path for path in found if not path.is_dir()))
    return found


def check_files(*paths: Path | None) -> None:
    """Refuse what cannot be read. Raises UsageError."""
    for path in paths:
        try:
            if path is not None:
                path.open("rb").close()
        except OSError as error:
            raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
