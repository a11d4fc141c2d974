"""One contract over every driver, each also with faults put in.

A new driver joins by an entry in `RIGS`; see drivers/README.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

pytest.register_assert_rewrite("tests.helpers.contract_suite")

from docs.examples.udp.example_arm import ExampleArm  # noqa: E402
from drivers.faults.driver import with_faults  # noqa: E402
from drivers.files.log import LogArm  # noqa: E402
from tests.helpers.contract_suite import CHECKS, Make, Rig, Start, Tapped  # noqa: E402
from tests.helpers.hardware_rigs import can_line, can_multicast, fci, ros2  # noqa: E402
from tests.helpers.live_tools import simulated_arm  # noqa: E402
from tests.helpers.mcap_tools import record, samples  # noqa: E402
from tests.helpers.udp_arm import running  # noqa: E402

FAULTS = ("lost", "late", "repeated", "reordered", "corrupt", "nan", "spike")


@contextmanager
def pybullet() -> Iterator[Start]:
    with ExitStack() as stack:

        def make():
            arm = simulated_arm()
            stack.callback(arm.close)
            return arm

        yield make


@contextmanager
def log() -> Iterator[Start]:
    with tempfile.TemporaryDirectory() as folder:
        path = record(Path(folder) / "a.mcap", samples(1000, links=True))
        yield lambda: LogArm(path)


@contextmanager
def example() -> Iterator[Start]:
    with running(joints=6) as port:
        yield lambda: ExampleArm(f"udp://127.0.0.1:{port}?timeout_ms=500", allow_motion=True)


@contextmanager
def example_listening() -> Iterator[Start]:
    """An arm whose wire loses, doubles and cuts datagrams, and a driver that may not move it."""
    with running(joints=3, bad=0.02) as port:
        yield lambda: ExampleArm(f"udp://127.0.0.1:{port}?joints=3&timeout_ms=500")


RIGS = [
    Rig("pybullet", pybullet),
    Rig("log", log, ends=True, moves=False),
    Rig("example", example, steady=False),
    Rig("example_listening", example_listening, moves=False, steady=False),
    Rig("fci_5", partial(fci, 5, True), steady=False, wire=True),
    Rig("fci_10", partial(fci, 10, True), steady=False, wire=True),
    Rig("fci_listening", partial(fci, 10, False), moves=False, steady=False, wire=True),
    Rig("can_line", can_line),
    Rig("can_multicast", can_multicast, steady=False, wire=True),
    Rig("ros2", partial(ros2, True), steady=False, wire=True),
    Rig("ros2_listening", partial(ros2, False), moves=False, steady=False, wire=True),
]


def with_trouble(rig: Rig) -> Rig:
    """The same driver behind faults."""

    text = ",".join(f"{name}=0.05" for name in FAULTS)

    @contextmanager
    def start() -> Iterator[Start]:
        with rig.start() as make:
            yield lambda: with_faults(Tapped(make()), text, seed=3)

    return replace(rig, name=f"faulty_{rig.name}", start=start, steady=False, faulty=FAULTS)


FAULTY_WIRE = "faulty_fci_5"
ALL = [*RIGS, *map(with_trouble, RIGS)]


def marks(rig: Rig) -> list[pytest.MarkDecorator]:
    """Faults are put in alike whatever the driver; of hardware one is enough for every day."""
    seldom = (
        rig.name.startswith(("faulty_fci", "faulty_can", "faulty_ros2")) and rig.name != FAULTY_WIRE
    )
    return [pytest.mark.alone] * rig.wire + [pytest.mark.slow] * seldom


CASES = [
    pytest.param(rig, check, id=f"{rig.name}-{check.__name__}", marks=marks(rig))
    for rig in ALL
    for check in CHECKS
    if rig.takes(check)
]


class Bench:
    """The rig that is open; another one takes its place."""

    def __init__(self) -> None:
        self._rig: Rig | None = None
        self._open = ExitStack()

    def make(self, rig: Rig) -> Make:
        """What makes drivers of this rig, opened where it is not."""
        if rig is not self._rig:
            self.close()
            self._make = Make(self._open.enter_context(rig.start()))
            self._open.callback(self._make.let_go)
            self._rig = rig
        return self._make

    def close(self) -> None:
        """Close what is open."""
        self._rig = None
        self._open.close()


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """One rig after the other, each for all its checks."""
    opened = Bench()
    yield opened
    opened.close()


@pytest.mark.parametrize(("rig", "check"), CASES)
def test_contract(bench: Bench, rig: Rig, check) -> None:
    make = bench.make(rig)
    try:
        check(rig, make)
    except BaseException:
        make.let_go()  # in whatever state it is
        raise
