"""The next run is of the same arm: it repeats what this one was told of it."""

from types import SimpleNamespace
from typing import Any

import pytest

from adapter.report.next_steps import _again


def run(command: str, **figures: Any) -> Any:
    return SimpleNamespace(figures=figures, model=SimpleNamespace(provenance={"command": command}))


@pytest.mark.parametrize(
    ("command", "kept"),
    [
        (
            "adapter run --driver my.py:Arm --robot a.urdf --config c.toml --out x --duration 5",
            "run --driver my.py:Arm --robot a.urdf --config c.toml",
        ),
        (
            "adapter run --scenario payload_at_20s --set mass=0.3 --set t_s=0 --seed 2 --view 0",
            "run --scenario payload_at_20s --set mass=0.3 --set t_s=0 --seed 2",
        ),
        (
            "adapter run --gravity 9.81 0 -1e-3 --out=x --allow-motion --yes --excitation designed",
            "run --gravity 9.81 0 -1e-3",
        ),
        ("-q tests", "run --driver fci://10.0.0.2 --scenario nominal"),
    ],
)
def test_words_of_the_arm_stay(command: str, kept: str) -> None:
    data = run(command, driver="fci://10.0.0.2", scenario="nominal")
    assert " ".join(_again(data)) == kept
