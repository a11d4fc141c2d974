"""What README and pages point to is there; what they tell people to type is given by a test."""

import re

import pytest

from adapter.cli.main import build_parser
from tests.helpers.pages import (
    NOT_GIVEN,
    PAGES,
    PYTHON,
    ROOT,
    blocks,
    every_command,
    given,
    options_of_commands,
    table_of_options,
)

DRAWN = "figures/"  # when the site is built, by docs/site/figures.py
# What a block of Python in a page calls, and so which test of test_commands.py runs it
CALLS = ("adapter.learn(", "find_gap", "MujocoArm", "SnapshotReader", "hour.mcap", "AnyReader")
RUN = (*CALLS, "adapter.Told(", "from_xml_path(", "read_servos(")  # the last: test_servo_hour.py


@pytest.mark.parametrize("page", PAGES)
def test_every_file_a_page_points_to_is_there(page: str) -> None:
    for target in re.findall(r"\]\((?!http|#)([^)#]+)(?:#[^)]*)?\)", PAGES[page]):
        found = (ROOT / page).parent.joinpath(target).exists()
        assert found or target.startswith(DRAWN), target


def test_no_command_is_left_out_without_need() -> None:
    for part in NOT_GIVEN:
        assert any(part in line for line in every_command()), part


def test_the_commands_for_simulated_hardware_are_those_that_are_given() -> None:
    kinds = [re.search(r"adapter sim (\w+)$|(\w+)://[\d.]+", line) for line in given(wire=True)]
    assert None not in kinds
    assert sorted(found[1] or found[2] for found in kinds if found) == ["can", "can", "fci", "fci"]


def test_every_block_of_python_is_run() -> None:
    own = [block for page in PAGES if page.startswith("docs/") for block in blocks(PYTHON, page)]
    assert [sum(call in block for call in RUN) for block in own] == [1] * len(RUN)


def test_options_stand_in_a_table_and_no_word_means_two_things(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One word takes one kind of value everywhere, or some of what it takes elsewhere; the arm as
    documented is --robot in every command, what was learned is --model."""
    assert table_of_options() in PAGES["docs/commands.md"], "python -m tests.helpers.pages"
    found = options_of_commands()
    for name, senses in found.items():
        takes = [{*kind.split("|")} for kind, _ in senses]
        assert all(one <= max(takes, key=len) for one in takes), (name, senses)
    for name, begins, more in (
        ("--robot", "the arm as documented", 8),
        ("--model", "write what", 0),
    ):
        senses = found[name]
        assert all(said.startswith(begins) for _, said in senses), senses
        assert sum(map(len, senses.values())) > more
    assert build_parser().parse_args(["gap", "x.mcap", "--model", "panda"]).model == "panda"
    assert "--model is --robot here" in capsys.readouterr().err
