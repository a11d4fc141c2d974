"""`adapter completion`: what a shell needs to complete command lines, and the completing itself."""

from __future__ import annotations

import argparse
import os
from importlib import import_module
from typing import Any

from adapter.cli.exit_codes import ExitCode
from adapter.model import robot_names
from adapter.shadowed import own_name

SHELLS = ("bash", "zsh", "fish")
# Options whose names another room knows: where they are, loaded when one is asked for.
LEARNED, SCENARIOS = ("adapter.effects.catalogue", "LEARNED"), ("sim.options", "SCENARIOS")
NAMES_OF = {"effects": LEARNED, "scenario": SCENARIOS}


def declare(parser: argparse.ArgumentParser) -> None:
    """Declare its option."""
    parser.description = (
        "Print what makes a shell complete adapter's commands, options and names. bash and zsh: "
        'eval "$(adapter completion bash)"; fish: adapter completion fish | source'
    )
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))


def run(args: argparse.Namespace) -> int:
    """Print it."""
    argcomplete = import_module("argcomplete")
    print(argcomplete.shellcode(["adapter"], shell=args.shell))
    return ExitCode.DONE


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer a shell that asks for completions, and end; else do nothing at all."""
    if "_ARGCOMPLETE" not in os.environ:  # a shell sets it to have a line completed
        return
    subparsers = (x for x in parser._actions if isinstance(x, argparse._SubParsersAction))
    for part in (parser, *(part for action in subparsers for part in action.choices.values())):
        for action in part._actions:
            if action.dest in ("robot", "model", "first", "second"):
                _complete_with(action, robot_names(), files=True)
            elif action.dest in NAMES_OF:
                module, name = NAMES_OF[action.dest]
                _complete_with(action, tuple(getattr(import_module(own_name(module)), name)))
    import_module("argcomplete").autocomplete(parser, always_complete_options=False)


def _complete_with(action: Any, names: tuple[str, ...], files: bool = False) -> None:
    """Offer these for an option, beside files where it takes such."""
    completers = import_module("argcomplete.completers")

    def offer(prefix: str, **_: Any) -> list[str]:
        known = [name for name in names if name.startswith(prefix)]
        return known + (list(completers.FilesCompleter()(prefix)) if files else [])

    action.completer = offer
