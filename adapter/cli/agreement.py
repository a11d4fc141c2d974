"""Before an arm that may be real is moved: what it holds, the plan and its page, and a yes."""

from __future__ import annotations

import argparse
import select
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from adapter.control.controller import ExcitationController
from adapter.control.excitation import plan_lines
from adapter.control.free_path import FreeMotion
from adapter.control.resting import check_resting_torque
from adapter.errors import SettingsError, UsageError
from adapter.report.plan_page import write_plan
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


def agree(
    args: argparse.Namespace,
    driver: Driver,
    controller: ExcitationController,
    duration_s: float,
    folder: Path,
    stopped: Callable[[], bool],
) -> None:
    """Check what the arm holds, show the plan and ask; the driver's samples are read meanwhile.

    Raises:
        SettingsError: the arm does not hold what its model says, or nobody agreed.
        DriverError: as the driver says.
        RunFolderError: the page cannot be written.
    """
    draw, motion, start = controller.draw, controller.reference, controller.start
    assert isinstance(draw, FreeMotion) and draw.least is not None
    assert motion is not None and start is not None
    model, limits = draw.arm.model, controller.limits
    if not args.trust_model:
        check_resting_torque(model, start.q, start.tau)
    lines = plan_lines(motion, limits, model.tree.joint_names, duration_s)
    lines.insert(-1, f"Nearest on the way: {draw.least} (margin {draw.arm.cell.margin:g} m).")
    with ThreadPoolExecutor(1) as pool:
        page = pool.submit(
            write_plan, folder / PLAN_PAGE, draw.arm, motion, limits, draw.least, lines
        )
        _read_until(page.done, driver)
        say("\n".join([*lines, f"As a page: {page.result()}"]))
    if not args.yes:
        _ask(driver, stopped)


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
