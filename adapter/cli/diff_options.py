"""Options of `adapter diff`."""

from __future__ import annotations

import argparse

from adapter.cli.options import add_joints, add_json, check_robot


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare them, and what checks them."""
    parser.description = (
        "What differs from model A to model B, joint by joint: frames, inertias and effects, by "
        "how many standard deviations, whether any data could show it, and what it does to torques "
        "and to the hand's place. Of one model alone: from its documentation to it."
    )
    add = parser.add_argument
    add("first", metavar="A", help="model file (.json), robot file or known name")
    add("second", nargs="?", metavar="B", help="the same; without it A and its documentation")
    add_joints(parser)
    add_json(parser, or_output=True)
    parser.set_defaults(check=_check)


def _check(args: argparse.Namespace) -> None:
    for name in (args.first, args.second):
        if name is not None:
            check_robot(name)
