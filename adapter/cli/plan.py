"""`adapter plan`: the plan of a run as lines and as a page; nothing moves."""

from __future__ import annotations

import argparse
import sys

import numpy as np

from adapter.cli.agreement import PLAN_PAGE
from adapter.cli.exit_codes import ExitCode
from adapter.cli.run import run_plan
from adapter.control.limits import MotionLimits, need_same_robot
from adapter.control.push_bound import push_bound
from adapter.control.resting import check_resting_torque
from adapter.report.next_steps import Step, command, without
from adapter.report.plan_page import Plan
from adapter.runs.terminal import results_folder, say, show


def run(args: argparse.Namespace) -> int:
    """Carry the subcommand out."""
    asked = run_plan(args)
    robot, limits = asked.robot, MotionLimits.of(asked.robot)
    draw = asked.free_motion()
    driver = asked.open(args.driver, False)
    driver.connect()
    try:
        for _ in range(200):  # the first with the position of every joint, else the last one
            sample = driver.read()
            if np.isfinite(sample.q).all() and np.isfinite(sample.tau).all():
                break
        need_same_robot(driver, limits)
    finally:
        driver.close()
    motion = draw(limits, sample.q, asked.config.excitation)
    assert draw.least is not None
    bound = push_bound(robot, motion, limits, asked.config.safety)
    plan = Plan(draw.arm, motion, limits, draw.least)
    lines = plan.lines(asked.duration_s + asked.config.excitation.slow_s, bound.lines())
    # the run of this plan: the same words, but where the plan goes
    kept = without(sys.argv[2:], ["--out"])
    kept += ["--allow-motion"] if asked.maybe_real and "--allow-motion" not in kept else []
    step = Step("Move the arm so", command("run", *kept))
    page = plan.write(results_folder(args.out, "plan") / PLAN_PAGE, lines, [step])
    for line in lines:
        show(line)
    show(f"next: {step.why}: {step.command}")
    say(f"As a page: {page}")
    if not args.trust_model:
        check_resting_torque(robot, sample.q, sample.tau)
    return ExitCode.DONE
