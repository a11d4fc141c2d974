"""One contract over every driver, each also with faults put in.

A new driver joins by an entry in `RIGS`; see drivers/README.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

pytest.register_assert_rewrite("contract_suite")

from contract_suite import CHECKS, Make, Rig  # noqa: E402
from hardware_rigs import can_multicast, can_virtual, fci  # noqa: E402
from live_tools import simulated_arm  # noqa: E402
from mcap_tools import record, samples  # noqa: E402
from udp_arm import running  # noqa: E402

from drivers.example_arm import ExampleArm  # noqa: E402
from drivers.faulty import with_faults  # noqa: E402
from drivers.log import LogArm  # noqa: E402

FAULTS = "lost=0.05,late=0.05,repeated=0.05,reordered=0.05,corrupt=0.05,nan=0.05,spike=0.05"


@contextmanager
def pybullet() -> Iterator[Make]:
    with ExitStack() as stack:

        def make():
            arm = simulated_arm()
            stack.callback(arm.close)
            return arm

        yield make


@contextmanager
def log() -> Iterator[Make]:
    with tempfile.TemporaryDirectory() as folder:
        path = record(Path(folder) / "a.mcap", samples(500, links=True))
        yield lambda: LogArm(path)


@contextmanager
def example() -> Iterator[Make]:
    with running(joints=6) as port:
        yield lambda: ExampleArm(f"udp://127.0.0.1:{port}?timeout_ms=500", allow_motion=True)


@contextmanager
def example_listening() -> Iterator[Make]:
    """An arm whose wire loses, doubles and cuts datagrams, and a driver that may not move it."""
    with running(joints=3, bad=0.02) as port:
        yield lambda: ExampleArm(f"udp://127.0.0.1:{port}?joints=3&timeout_ms=500")


RIGS = [
    Rig("pybullet", pybullet),
    Rig("log", log, ends=True, moves=False),
    Rig("example", example, steady=False),
    Rig("example_listening", example_listening, moves=False, steady=False),
    Rig("fci_5", fci(5, True), steady=False),
    Rig("fci_10", fci(10, True), steady=False),
    Rig("fci_listening", fci(10, False), moves=False, steady=False),
    Rig("can_virtual", can_virtual, steady=False),
    Rig("can_multicast", can_multicast, steady=False),
]


def with_trouble(rig: Rig) -> Rig:
    """The same driver behind faults."""

    @contextmanager
    def start() -> Iterator[Make]:
        with rig.start() as make:
            yield lambda: with_faults(make(), FAULTS, seed=3)

    return Rig(f"faulty_{rig.name}", start, rig.ends, False, rig.moves, False)


ALL = [*RIGS, *map(with_trouble, RIGS)]


@pytest.fixture(scope="module", params=ALL, ids=lambda rig: rig.name)
def rigged(request: pytest.FixtureRequest) -> Iterator[tuple[Rig, Make]]:
    """A driver, and what it speaks to, for all checks of this module."""
    rig: Rig = request.param
    with rig.start() as make:
        yield rig, make


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(rigged: tuple[Rig, Make], check) -> None:
    check(*rigged)
