"""What each format keeps of an effect: the table of the docs, asked of the effects themselves.

    python -m tests.effects.test_formats

prints it.
"""

from __future__ import annotations

from dataclasses import replace

from adapter.effects.c_text import c_text
from adapter.effects.catalogue import KNOWN
from adapter.effects.robots import additions, how
from adapter.model.mjcf_text import MJCF_PLACES
from adapter.model.urdf_text import URDF_PLACES
from tests.helpers.pages import PAGES
from tests.simulate.test_rollouts import BALL, CASES, SENSED, model_with

ROUND = [2e-3, 0.0, 0.0, 2e-3, 0.0, 2e-3]  # kg m2, of 1 kg
PAGE = "docs/simulate-what-was-learned.md"


def table() -> str:
    """A row for each effect: in a URDF, in an MJCF, in C."""
    lines = ["| effect | URDF | MJCF | C |", "|---|---|---|---|"]
    ball = replace(CASES[0], name="payload", joints=(), parameters={**BALL, "inertia": ROUND})
    for name, effect in {x.name: x for x in (*CASES, *SENSED, ball)}.items():
        model, title = model_with(replace(effect, interval_s=None)), KNOWN[name].title
        kept = [additions(model, places).kept for places in (URDF_PLACES, tuple(MJCF_PLACES))]
        cells = [title, *(how(own[0].part) for own in (*kept, c_text(model).kept))]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def test_the_table_of_formats_is_what_effects_do() -> None:
    assert table() in PAGES[PAGE], "python -m tests.effects.test_formats"


if __name__ == "__main__":
    print(table())
