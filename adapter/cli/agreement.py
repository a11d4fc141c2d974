"""Before an arm that may be real is moved: what it holds, the plan and its page, and a yes."""

from __future__ import annotations

import argparse
import select
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from adapter.control.controller import ExcitationController
from adapter.control.free_path import FreeMotion
from adapter.control.push_bound import push_bound
from adapter.errors import SettingsError, UsageError
from adapter.report.plan_page import Plan
from adapter.runs.terminal import say
from drivers.interface import Driver

PLAN_PAGE = "plan.html"


def need_somebody(agreed: bool) -> None:
    """Refuse a motion that nobody can be asked about. Raises UsageError."""
    if not (agreed or sys.stdin.isatty()):
        raise UsageError(
            "an arm that may be real is moved when somebody agrees to the plan, and there is no "
            "terminal to ask on; give --yes (`adapter plan` shows the plan alone)"
        )


def reading(driver: Driver) -> Callable[[], None]:
    """What takes the samples that came in since it was called last: none may wait for long."""
    taken_ns = [0]

    def read() -> None:
        now_ns = time.monotonic_ns()
        count = (now_ns - taken_ns[0]) // driver.period_ns if taken_ns[0] and driver.paced else 1
        taken_ns[0] = now_ns
        for _ in range(min(count, 200)):  # at once
            driver.read()
            if driver.arrived_ns >= now_ns:  # it had to be waited for: no more is there
                return

    return read


def agree(
    args: argparse.Namespace,
    driver: Driver,
    controller: ExcitationController,
    duration_s: float,
    folder: Path,
    stopped: Callable[[], bool],
) -> Callable[[], Path] | None:
    """Check what the arm holds, show the plan and ask; the driver's samples are read meanwhile.

    Returns:
        What writes the page after the run, where nobody was asked; None where it is written.

    Raises:
        SettingsError: the arm does not hold what its model says, or nobody agreed.
        DriverError: as the driver says.
        RunFolderError: the page cannot be written.
    """
    draw, motion, start = controller.draw, controller.reference, controller.start
    assert isinstance(draw, FreeMotion) and draw.least is not None
    assert motion is not None and start is not None
    if controller.weight is not None and controller.weight.refusal is not None:
        raise SettingsError(controller.weight.refusal)
    bound = push_bound(draw.arm.model, motion, controller.limits, controller.safety)
    plan = Plan(draw.arm, motion, controller.limits, draw.least)
    lines = plan.lines(duration_s, bound.lines())
    say("\n".join(lines))
    write = partial(plan.write, folder / PLAN_PAGE, lines)
    if args.yes:  # nobody looks at it now, and the arm's samples do not wait
        return write
    with ThreadPoolExecutor(1) as pool:
        page = pool.submit(write)
        _read_until(page.done, driver)
        say(f"As a page: {page.result()}")
    _ask(driver, stopped)
    return None


def _ask(driver: Driver, stopped: Callable[[], bool]) -> None:
    say("Move the arm? yes, or anything else to leave it:")
    answered = lambda: bool(select.select([sys.stdin], [], [], 0.0)[0])  # noqa: E731
    _read_until(lambda: stopped() or answered(), driver)
    if stopped() or sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise SettingsError("nobody agreed to the plan; the arm was not moved")


def _read_until(done: Callable[[], bool], driver: Driver) -> None:
    """Take the arm's samples, so that none waits, until something is done. Raises DriverError."""
    while not done():
        driver.read()
        if not driver.paced:
            time.sleep(1e-9 * driver.period_ns)
