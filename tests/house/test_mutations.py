"""The list of small errors that `make trials` plants, held to the code as it stands."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.mutations import ROOT, Mutation, mutations

LISTED = mutations()
FEWEST = 50


@pytest.mark.parametrize("mutation", LISTED, ids=lambda m: f"{Path(m.file).stem}: {m.was[:30]}")
def test_each_stands_in_the_code_once_and_can_be_planted(mutation: Mutation) -> None:
    text = (ROOT / mutation.file).read_text("utf-8")
    changed = mutation.applied(text)
    assert changed != text
    compile(changed, mutation.file, "exec")


@pytest.mark.parametrize("test", sorted({test for m in LISTED for test in m.tests}))
def test_those_that_should_notice_exist(test: str) -> None:
    path, _, name = test.partition("::")
    assert (ROOT / path).exists()
    assert not name or f"\ndef {name}(" in (ROOT / path).read_text("utf-8")


def test_there_are_enough_and_each_once() -> None:
    assert len({(m.file, m.was, m.now) for m in LISTED}) == len(LISTED) >= FEWEST


def test_a_text_that_is_missing_or_stands_twice_is_refused() -> None:
    mutation = Mutation("a.py", "x = 1", "x = 2", ())
    assert mutation.applied("x = 1\n") == "x = 2\n"
    for text in ("", "x = 1\nx = 1\n"):
        with pytest.raises(ValueError, match="stands there"):
            mutation.applied(text)
