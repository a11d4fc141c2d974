"""What README and pages point to is there; what they tell people to type is given by a test."""

import re

import pytest

from tests.helpers.pages import NOT_GIVEN, PAGES, PYTHON, ROOT, blocks, every_command, given

DRAWN = "figures/"  # when the site is built, by docs/site/figures.py
# What a block of Python in a page calls, and so which test of test_commands.py runs it
CALLS = ("adapter.learn(", "find_gap", "MujocoArm", "SnapshotReader", "hour.mcap", "AnyReader")
RUN = (*CALLS, "adapter.Told(", "from_xml_path(")  # the last: test_servo_hour.py


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
