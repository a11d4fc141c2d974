"""`adapter plan`: the plan of a run as lines and as a page; nothing moves."""

from __future__ import annotations

import argparse
import sys

import numpy as np

from adapter.cli.agreement import PLAN_PAGE, whole_plan
from adapter.cli.exit_codes import ExitCode
from adapter.cli.run import run_plan
from adapter.control.limits import MotionLimits, need_same_robot
from adapter.control.push_bound import push_bound
from adapter.control.resting import check_resting_torque
from adapter.report.next_steps import Step, command, without
from adapter.report.plan_page import PlanWords, write_plan
from adapter.runs.terminal import results_folder, say, show

READS = 200  # among which every joint has to be measured


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    plan = run_plan(args)
    robot, limits = plan.robot, MotionLimits.of(plan.robot)
    draw = plan.free_motion(args.duration)
    driver = plan.open(args.driver, False)
    driver.connect()
    try:
        for _ in range(READS):  # the first with the position of every joint, else the last one
            sample = driver.read()
            if np.isfinite(sample.q).all() and np.isfinite(sample.tau).all():
                break
        need_same_robot(driver, limits)
    finally:
        driver.close()
    motion = draw(limits, sample.q, plan.config.excitation)
    assert draw.least is not None
    duration_s = args.duration + plan.config.excitation.slow_s
    bound = push_bound(robot, motion, limits, plan.config.safety)
    lines = whole_plan(draw.arm, motion, limits, duration_s, draw.least, bound.lines())
    page = results_folder(args.out, "plan") / PLAN_PAGE
    # the run of this plan: the same words, but where the plan goes
    kept = without(sys.argv[2:], ["--out"])
    kept += ["--allow-motion"] if plan.maybe_real and "--allow-motion" not in kept else []
    steps = [Step("Move the arm so", command("run", *kept))]
    write_plan(page, draw.arm, motion, limits, draw.least, PlanWords(lines, steps))
    for line in lines:
        show(line)
    for step in steps:
        show(f"next: {step.why}: {step.command}")
    say(f"As a page: {page}")
    if not args.trust_model:
        check_resting_torque(robot, sample.q, sample.tau)
    return ExitCode.DONE
