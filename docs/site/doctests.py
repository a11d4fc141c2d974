"""Doctests at the end of docstrings become examples: Google's style wants a heading."""

from __future__ import annotations

from textwrap import indent
from typing import Any

import griffe

PROMPT = "\n>>> "


class Doctests(griffe.Extension):
    """Puts `Examples:` above what begins with a prompt."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Called for each module, class, function and attribute that was read."""
        if obj.docstring and PROMPT in obj.docstring.value:
            text, _, doctest = obj.docstring.value.partition(PROMPT)
            example = indent(PROMPT.lstrip() + doctest, "    ")
            obj.docstring.value = f"{text}\n\nExamples:\n{example}"
