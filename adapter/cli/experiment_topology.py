"""Recordings for discovery in the experiments: falls seen by their sensors, a Panda that moves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from adapter.controller import ExcitationController
from adapter.excitation import ExcitationSettings, MotionLimits
from adapter.pipeline import PipelineSettings, make_front_end
from adapter.realtime.lockstep import run_lockstep
from adapter.robots import documented
from drivers.interface import JointSample
from drivers.mcap_file import Log
from drivers.pybullet_arm import PyBulletArm
from sim.free_fall import RATE_HZ
from sim.free_fall_data import FallData
from sim.scenarios import build

MOTION_S = 10.0  # of each recording, from its start (the project's goal: at most that)


def fall_logs(noisy: FallData, count: int) -> Iterator[Log]:
    """What joints, gyroscopes and accelerometers of falling robots say, one log per fall.

    Neither velocities nor angular accelerations are in them: no such sensor is.
    """
    truth = noisy.truth
    for k in range(min(count, len(noisy))):
        measured = noisy[k]
        q = measured["q"]
        turning, pull = (
            np.concatenate([measured[f"base_{x}"][:, None], measured[f"link_{x}"]], axis=1)
            for x in ("w", "a")
        )
        nothing = np.full_like(turning, np.nan)
        log = Log(
            Path(f"fall {k}"),
            tuple(truth.joint_names),
            np.arange(len(q)) * round(1e9 / RATE_HZ),
            q,
            measured["dq"],
            measured["tau"],
            (truth.base_name, *truth.link_names),
            np.concatenate([nothing, turning], axis=2),
            np.concatenate([pull, nothing], axis=2),
        )
        yield _first(log)


def panda_logs(count: int, seed: int) -> Iterator[Log]:
    """What simulated Pandas with bent links say, each moving by itself; one log per seed."""
    robot = documented("panda")
    limits = MotionLimits.of(robot)
    for k in range(seed, seed + count):
        arm = PyBulletArm(build("bent_link", k).plant())
        controller = ExcitationController(limits, ExcitationSettings(seed=k))
        samples: list[JointSample] = []

        def keep(sample: JointSample, command: object, into: list[JointSample] = samples) -> None:
            into.append(sample)

        front_end = make_front_end(robot, PipelineSettings())
        try:
            run_lockstep(arm, front_end, controller=controller, duration_s=MOTION_S, each=keep)
        finally:
            arm.close()
        yield _first(_log_of(arm, samples))


def _log_of(arm: PyBulletArm, samples: Sequence[JointSample]) -> Log:
    links = [sample.links for sample in samples if sample.links is not None]
    return Log(
        Path("simulated Panda"),
        arm.joint_names,
        np.array([sample.stamp_ns for sample in samples]),
        np.array([sample.q for sample in samples]),
        np.array([sample.dq for sample in samples]),
        np.array([sample.tau for sample in samples]),
        arm.link_names,
        np.array([motion.twist for motion in links]),
        np.array([motion.accel for motion in links]),
    )


def _first(log: Log) -> Log:
    """The first seconds of a recording."""
    stop = int(np.searchsorted(log.stamp_ns, log.stamp_ns[0] + round(1e9 * MOTION_S)))
    assert log.twists is not None and log.accels is not None
    return Log(
        log.path, log.joint_names, log.stamp_ns[:stop], log.q[:stop], log.dq[:stop],
        log.tau[:stop], log.link_names, log.twists[:stop], log.accels[:stop],
    )  # fmt: skip
