"""Lockstep runs of the simulated Panda behind faults, and how two learners compare."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.learning.learner import OnlineLearner
from adapter.physics.freedom import Freedom
from adapter.realtime.session import Session, run_lockstep
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import collect, frame_errors
from adapter.runs.pipeline import make_front_end, make_learner
from adapter.signals.front_end import FrontEnd
from adapter.signals.records import stamp_of
from drivers.faults.driver import FaultyDriver, with_faults
from drivers.files.log import LogArm
from drivers.files.mcap import write_log
from drivers.interface import Driver
from tests.helpers.arm_data import Motion, arm, model_torque, panda_model, record, rms
from tests.helpers.live_tools import simulated_arm

N = 7
SEED, FAULT_SEED = 5, 1


class Watched:
    """A learner that asks of every estimate whether it is finite, and keeps it."""

    def __init__(self, learner: OnlineLearner) -> None:
        self.learner, self.finite = learner, True
        self.history: list[np.ndarray] = []
        self.stamps_ms: list[int] = []

    def step(self, state) -> None:
        assert np.isfinite(state[2:30]).all(), "a state that is no number reached the learner"
        self.learner.step(state)
        theta = self.learner.theta.theta
        self.history.append(theta.copy())
        self.stamps_ms.append(stamp_of(state) // 1_000_000)
        schema = self.learner.schema
        known = theta, schema.R0, schema.p, self.learner.theta.effect_values
        self.finite = self.finite and all(np.isfinite(x).all() for x in known)


@dataclass(frozen=True)
class FaultRun:
    """What a run came to; θ (7, 10) after each state learned from, and the stamps of these."""

    text: str
    driver: FaultyDriver
    front_end: FrontEnd
    learner: OnlineLearner
    result: Session
    watched: Watched

    @property
    def refused(self) -> dict[str, int]:
        """By reason."""
        return dict(self.front_end.refused)

    def check_balance(self) -> None:
        """Every sample is accounted for, from the driver to the learner."""
        account, intake = self.driver.account, self.driver.intake
        assert account.balanced, account
        assert intake.received == intake.used + sum(intake.refused.values())
        assert intake.used == account.taken
        # a sample that a fault of the loop ends the run with was still delivered
        assert account.delivered == self.result.samples
        assert self.result.samples == self.result.passed_on + sum(self.refused.values())
        assert self.learner.learned == self.result.passed_on


def _run(
    arm: Driver, text: str, controller: ExcitationController | None, seconds: float
) -> FaultRun:
    settings, robot = PipelineSettings(), panda_model()
    front_end, learner = make_front_end(robot, settings), make_learner(robot, settings)
    driver, watched = with_faults(arm, text, FAULT_SEED), Watched(learner)
    try:
        result = run_lockstep(driver, front_end, watched, controller, seconds)
    finally:
        driver.close()
    return FaultRun(text, driver, front_end, learner, result, watched)


def run_faulty(text: str, seconds: float) -> FaultRun:
    """The simulated Panda in motion, behind these faults, for so long on its own stamps."""
    limits = MotionLimits.of(panda_model())
    controller = ExcitationController(limits, ExcitationSettings(seed=SEED))
    return _run(simulated_arm(SEED), text, controller, seconds)


@cache
def clean_run(seconds: float) -> FaultRun:
    """The same without faults."""
    return run_faulty("", seconds)


@cache
def _recording(seconds: float) -> LogArm:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "motion.mcap"
        write_log(record(arm(), Motion(seconds, SEED)).log(), path, {})
        return LogArm(path)


@cache
def heard(text: str, seconds: float) -> FaultRun:
    """An arm that somebody else moves, behind these faults: nothing is commanded."""
    return _run(copy(_recording(seconds)), text, None, 2.0 * seconds)


@dataclass(frozen=True)
class Difference:
    """How far two learners are apart.

    Attributes:
        theta: largest |θa - θb| over the root of the sum of both variances.
        torque: rms of the same for torques (m, n) that the two predict on held-out motion.
        rotation_rad, position_m: of λ, in its observable directions, largest over the links.
        error_ratio: torque error of b on held-out motion over that of a.
    """

    theta: float
    torque: float
    rotation_rad: float
    position_m: float
    error_ratio: float


@cache
def _held_out() -> tuple[np.ndarray, ...]:
    return tuple(x[500::40] for x in record(arm(), Motion(6.0, 105), noisy=False).true)


def _torque(learner: OnlineLearner, theta: np.ndarray) -> np.ndarray:
    q, dq, ddq, _ = _held_out()
    return model_torque(panda_model(), learner.schema.lam, theta, q, dq, ddq)


def difference(a: OnlineLearner, b: OnlineLearner) -> Difference:
    """Of the learner b from the learner a."""
    one, two = collect(a), collect(b)
    apart = (one.theta - two.theta).ravel()
    covariance = (one.covariance + two.covariance)[: 10 * N, : 10 * N]
    columns = np.array([_torque(a, unit.reshape(N, 10)) for unit in np.eye(10 * N)])
    spread = np.sqrt(np.einsum("amj,ab,bmj->mj", columns, covariance, columns))
    torque = np.einsum("a,amj->mj", apart, columns)
    freedom = Freedom.of(np.eye(6) - one.lam_identifiable, one.lam[:, 3:])
    rotation, position = frame_errors(two.lam, one.lam, freedom)
    tau = _held_out()[3]
    errors = [np.linalg.norm(rms(tau - _torque(x, x.theta.theta))) for x in (a, b)]
    return Difference(
        theta=float((np.abs(apart) / np.sqrt(covariance.diagonal())).max()),
        torque=float(np.sqrt(np.mean((torque / spread) ** 2))),
        rotation_rad=float(rotation.max()),
        position_m=float(position.max()),
        error_ratio=float(errors[1] / errors[0]),
    )
