"""The paper's Panda (section IV.B) on the simulated arm, sample by sample as live."""

from __future__ import annotations

import tempfile
from pathlib import Path

from adapter.cli.common import plain
from adapter.cli.experiment_topology import panda_logs
from adapter.controller import ExcitationController
from adapter.excitation import ExcitationSettings, MotionLimits
from adapter.experiment.panda import panda_results
from adapter.experiment.results import PandaResults
from adapter.experiment.topology import topology_trials
from adapter.learner import LearnerSettings
from adapter.outcome import collect
from adapter.pipeline import PipelineSettings, make_front_end, make_learner
from adapter.realtime.lockstep import run_lockstep
from adapter.robots import documented
from adapter.run_folder import run_data
from adapter.score import figures, reference_from
from drivers.interface import JointSample
from drivers.pybullet_arm import PyBulletArm
from sim.scenarios import build


def run_panda(seed: int, duration_s: float, topologies: int) -> PandaResults:
    """Learn for some seconds of arm time from the first motion on; λ starts near zero.

    Args:
        seed: of everything random.
        duration_s: of the learning.
        topologies: how many other recordings are shuffled, for discovery to find their tree.
    """
    robot, world = documented("panda"), build("nominal", seed)
    settings = PipelineSettings(learner=LearnerSettings(seed=seed))
    front_end, learner = make_front_end(robot, settings), make_learner(robot, settings)
    controller = ExcitationController(MotionLimits.of(robot), ExcitationSettings(seed=seed))
    stamps: list[int] = []

    def note(sample: JointSample, command: object) -> None:
        stamps.append(sample.stamp_ns)

    arm = PyBulletArm(world.plant())
    try:
        done = run_lockstep(arm, front_end, learner, controller, duration_s, each=note)
    finally:
        arm.close()
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.json"
        world.write_truth(truth)
        reference = reference_from(truth, robot)
    outcome = collect(learner)
    numbers = figures(
        outcome,
        robot,
        reference,
        samples=done.samples,
        refused=front_end.refused,
        first_moving_ns=front_end.first_moving_ns,
        tick_us={},
        missed_deadlines=0,
        delay_s=front_end.delay_s,
    )
    run = run_data(
        outcome,
        robot,
        plain(numbers),
        reference,
        delay_s=front_end.delay_s,
        first_moving_ns=front_end.first_moving_ns,
    )
    found = topology_trials(panda_logs(topologies, seed), robot.tree, seed)
    return panda_results(run, (len(stamps) - 1) / (1e-9 * (stamps[-1] - stamps[0])), found)
