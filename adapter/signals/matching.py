"""A recording's joints and links held against those of a robot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adapter.model.locking import FOLLOWS, locked
from adapter.model.self_model import SelfModel
from drivers.files.mcap import IN_MEMORY, Log
from drivers.interface import DriverError

# What a joint may be off the one that it follows: play, in rad or m, and a share of its motion
FOLLOWED, FOLLOWED_SHARE = 1e-3, 0.1


def present(
    documented: SelfModel, names: Sequence[str], source: object
) -> tuple[SelfModel, list[str]]:
    """The robot with the joints that a recording or an arm lacks (a gripper's) locked at zero.

    Of one that it has, and the robot holds still (a gripper's finger), a sentence speaks.

    Args:
        names: joints of the recording or the arm; where it has none of the robot's, nothing is
            locked: it may be the same arm under other names, or another arm.
        source: what lacks them, for the sentence.

    Returns:
        The robot, and a sentence where joints were locked.
    """
    followers = documented.provenance.get(FOLLOWS, {})  # `matching` checks those with their leader
    checked = [name for name, (leader, *_) in followers.items() if leader in names]
    held = [frame.joint for frame in documented.frames if frame.joint in names]
    still = [name for name in held if name not in checked]
    how = "holds still (--joints A,B,... with them among these learns them)"
    idle = [f"{source}: has {', '.join(still)}, which {documented.name} {how}"] if still else []
    absent = [name for name in documented.tree.joint_names if name not in names]
    if not absent or len(absent) == documented.tree.n:
        return documented, idle
    said = f"{source}: has no joint {', '.join(absent)}; locked at zero in {documented.name} "
    said += "(--lock JOINT=VALUE gives another value)"
    return locked(documented, dict.fromkeys(absent, 0.0)), [said, *idle]


def counted(documented: SelfModel, source: object, count: int | None) -> tuple[str, ...]:
    """Names of the robot's joints that an arm of `count` joints without names has.

    Where the robot has more they are those that one name numbers from 1 to `count` (panda_joint1
    to 7), or else the first ones up to where the tree forks: a gripper of two fingers.

    Raises:
        DriverError: it could be others; names the robot's joints and the options.
    """
    tree = documented.tree
    names = tree.joint_names
    if count is None or count >= len(names):
        return names
    stems = {name.removesuffix(_number(name)) for name in names}
    rows = [tuple(f"{stem}{k + 1}" for k in range(count)) for stem in sorted(stems)]
    rows = [row for row in rows if {*row} <= {*names} and f"{row[0][:-1]}{count + 1}" not in names]
    children = [[k for k, i in enumerate(tree.parent) if i == j] for j in range(-1, count)]
    chain = all(below == [j] for j, below in enumerate(children[:-1]))
    if not rows and chain and len(children[-1]) > 1:
        rows = [names[:count]]
    if len(rows) != 1:
        raise DriverError(
            f"{source}: has {count} joints and tells no names, {documented.name} has {len(names)}: "
            f"{', '.join(names)}; name those that move (--joints A,B,C), or lock the others "
            "(--lock JOINT=VALUE)"
        )
    return rows[0]


def matching(log: Log, documented: SelfModel) -> Log:
    """The recording with the robot's joints in the robot's order, and its links' motion.

    Names that differ in nothing but a namespace (left/panda_joint3), or in what stands before
    their number (fer_joint3 for panda_joint3), are taken to mean the same joint, with a warning.

    Raises:
        DriverError: a joint of the robot is not in the recording; names both lists.
    """
    tree = documented.tree
    joints, warnings = corresponding(tree.joint_names, log.joint_names, "joint")
    missing = [name for name, found in zip(tree.joint_names, joints, strict=True) if found is None]
    if missing:
        if arms := several(tree.joint_names, log):
            raise DriverError(arms)
        raise DriverError(
            f"{log.path}: has no joint {', '.join(missing)}; it has {', '.join(log.joint_names)}; "
            f"{documented.name} has {', '.join(tree.joint_names)}"
        )
    links, more = corresponding(tree.link_names, log.link_names, "link")
    heard = all(links) and log.twists is not None and log.accels is not None
    if tree.floating:  # see `twist`
        if heard:
            said = "is not used where the base floats; it is synthesized"
            more.append(f"{log.path}: the measured motion of links {said}")
        heard = False
    elif log.link_names and not heard:
        more.append(
            f"{log.path}: motion of not all links was recorded (twists and accelerations of "
            f"{', '.join(tree.link_names)}); link motion is synthesized instead"
        )
    more += _strayed(log, documented)
    log = log.select([name for name in joints if name], [name for name in links if name and heard])
    log.warnings.extend(warnings + more)
    return log


def _strayed(log: Log, documented: SelfModel) -> list[str]:
    """Sentences on recorded joints that do not follow others as the robot's file says."""
    found = []
    for name, (leader, factor, offset, unit) in documented.provenance.get(FOLLOWS, {}).items():
        if not {name, leader} <= {*log.joint_names}:
            continue
        own, led = (
            np.concatenate([part.q[:, log.joint_names.index(x)] for part in log.spread()])
            for x in (name, leader)
        )
        off = float(np.sqrt(np.nanmean((own - factor * led - offset) ** 2)))
        if off > max(FOLLOWED, FOLLOWED_SHARE * float(np.nanstd(own))):
            said = f"{factor:g} times {leader} plus {offset:g}, as {documented.name} has it"
            found.append(f"{log.path}: {name} is {off:.3g} {unit} (rms) off {said}")
    return found


def corresponding(
    want: tuple[str, ...], have: tuple[str, ...], what: str
) -> tuple[list[str | None], list[str]]:
    """For each wanted name the one in `have` (None: not there), and warnings."""
    if all(name in have for name in want):
        return list(want), []
    starts = prefixes(want, have)
    if len(starts) == 1:  # of a namespace, beside joints of other things
        said = f"{what} names are taken without the {starts[0]} before them"
        return [f"{starts[0]}{name}" for name in want], [said]
    number = {_number(name): name for name in have}
    found = [number.get(_number(name)) for name in want]
    if not len(want) == len(have) == len(number) or None in found or "" in number:
        return [name if name in have else None for name in want], []
    pairs = ", ".join(f"{a} = {b}" for a, b in zip(found, want, strict=True))
    return found, [f"{what} names differ and are matched by their numbers: {pairs}"]


def prefixes(want: Sequence[str], have: Sequence[str]) -> list[str]:
    """What stands before all the wanted names in `have`: `left/` and `right_`, of several arms."""
    each = [{x.removesuffix(name) for x in have if x.endswith(name)} for name in want]
    return sorted(x for x in set.intersection(*each) if x.endswith(tuple("/:._"))) if each else []


def several(want: Sequence[str], log: Log) -> str:
    """A sentence on a recording of several arms with these joints, "" of any other."""
    arms = prefixes(want, log.joint_names)
    if len(arms) < 2:
        return ""
    one = f"adapter import {log.path} --names '{arms[0]}*=*' --to FILE"
    return f"{log.path}: has {len(arms)} such arms, {' and '.join(arms)}; take one: {one}"


def _number(name: str) -> str:
    return name[len(name.rstrip("0123456789")) :]


def most_moved(log: Log) -> Log:
    """A recording in memory as it is; of a mapped one a part in which the arm moves a lot."""
    if not log.is_mapped:
        return log
    parts = log.spread()
    speeds = [float(np.mean(np.nan_to_num(part.dq) ** 2)) for part in parts]
    middle = int(np.argmax(speeds)) * len(log) // len(parts)
    start = max(min(middle - IN_MEMORY // 2, len(log) - IN_MEMORY), 0)
    return log.piece(start, start + IN_MEMORY)
