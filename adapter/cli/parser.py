"""Command lines whose mistakes are told in one sentence, with the likeliest choice."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

from adapter.cli.exit_codes import ExitCode
from drivers.errors import choices

_NUMBER = re.compile(r"invalid (float|int) value: ")
_KINDS = {"float": "takes a number, got ", "int": "takes a whole number, got "}


class Parser(argparse.ArgumentParser):
    """As argparse's, with other sentences, and without the usage of all options before them."""

    def __init__(self, *args: Any, **options: Any) -> None:
        # an option cut short would be another one's: `--mode` is no `--model`
        super().__init__(*args, **{"allow_abbrev": False, **options})

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does; an option that nobody knows is told with one that is alike."""
        found, unknown = self.parse_known_args(args, namespace)
        if unknown:
            parser = self._used(found)
            parser.error(f"{parser.prog} has no {_told(unknown[0], list(parser._options()))}")
        return found

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, on the standard error, and end."""
        said = message.removeprefix("argument ")
        said = _NUMBER.sub(lambda found: _KINDS[found[1]], said)
        said = said.replace("the following arguments are required", "missing")
        self.exit(ExitCode.WRONG_USE, f"error: {said} ({self.prog} --help tells more)\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        what = (action.metavar or action.dest) if not action.option_strings else "choice"
        have = choices(value, map(str, action.choices))
        raise argparse.ArgumentError(action, f"no {str(what).lower()} '{value}'; {have}")

    def _options(self) -> Iterator[str]:
        for action in self._actions:
            yield from (name for name in action.option_strings if name.startswith("--"))

    def _used(self, found: argparse.Namespace) -> Parser:
        """The parser of the command that was given."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                chosen = action.choices.get(str(getattr(found, action.dest, None)))
                if isinstance(chosen, Parser):
                    return chosen
        return self


def _told(word: str, options: Sequence[str]) -> str:
    name = word.partition("=")[0]
    if not name.startswith("-"):
        return f"use for '{word}'"
    told = choices(name.lstrip("-"), [option.lstrip("-") for option in options])
    _, there, alike = told.partition("; did you mean ")
    return f"option '{name}'" + (f"; did you mean --{alike}" if there else "")
