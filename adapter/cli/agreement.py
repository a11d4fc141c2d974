"""Before an arm that may be real is moved: what it holds, the plan and its page, and a yes."""

from __future__ import annotations

import argparse
import select
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from adapter.control.controller import ExcitationController
from adapter.control.excitation import plan_lines
from adapter.control.free_path import ArmInCell, Clearance, FreeMotion
from adapter.control.limits import MotionLimits
from adapter.control.path_motion import PathMotion
from adapter.control.push_bound import push_bound
from adapter.errors import SettingsError, UsageError
from adapter.report.plan_page import PlanWords, write_plan
from adapter.runs.terminal import say
from drivers.interface import Driver

PLAN_PAGE = "plan.html"
MOST_READS = 200  # at once


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
        for _ in range(min(count, MOST_READS)):
            driver.read()
            if driver.arrived_ns >= now_ns:  # it had to be waited for: no more is there
                return

    return read


def whole_plan(
    arm: ArmInCell,
    motion: PathMotion,
    limits: MotionLimits,
    duration_s: float,
    least: Clearance,
    more: Sequence[str] = (),
) -> list[str]:
    """Lines of a motion, with what it comes nearest to and more of its kind before the last."""
    lines = plan_lines(motion, limits, arm.model.tree.joint_names, duration_s)
    nearest = f"Nearest on the way: {least} (margin {arm.cell.margin:g} m)."
    return [*lines[:-1], nearest, *more, lines[-1]]


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
    limits, least = controller.limits, draw.least
    if controller.weight is not None and controller.weight.refusal is not None:
        raise SettingsError(controller.weight.refusal)
    bound = push_bound(draw.arm.model, motion, limits, controller.safety)
    lines = whole_plan(draw.arm, motion, limits, duration_s, least, bound.lines())
    say("\n".join(lines))

    def write() -> Path:
        return write_plan(folder / PLAN_PAGE, draw.arm, motion, limits, least, PlanWords(lines))

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
