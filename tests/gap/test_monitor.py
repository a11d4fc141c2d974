"""The watch over the residual names what is new, soon and once, and is quiet where nothing is."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from adapter.effects.catalogue import REAL_ARM_EFFECTS
from adapter.gap.monitor import Blocks, Monitor
from adapter.gap.monitor_evidence import Belief
from adapter.gap.monitor_judge import sentence
from adapter.physics.rigid_arm import RigidArm
from adapter.realtime.run_messages import RunMessages
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import collect
from adapter.runs.replay import ReplayOptions, replay
from adapter.signals.front_end import FrontEnd
from adapter.signals.records import StateLayout
from drivers.files.estimates import EstimateNames
from sim.scenarios import build
from tests.helpers.arm_data import ArmData, Motion, arm, learner_for, panda_model, record, states_of
from tests.hidden.sizes import draw_bristles

AT_S, EARLY_S, SECONDS, CONTACT_S = 15.0, 6.0, 18.0, 1.5
FORCE_N = np.array([-6.0, 3.0, 7.4])  # 10 N in all
FRICTION_NM = np.array([0.27, 0.20, 0.14, 0.45, 0.30, 0.15, 0.25])
ROWS = 10  # states at a time where ADAM's path does not matter
# Motions and noise; all but the first of them for `make trials`
SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))]
QUIET = [20, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(21, 30))]


def disturbed(kind: str, seed: int) -> ArmData:
    """A recording with something new at 15 s; torques made here, not by the catalogue."""
    at_s = {"payload": AT_S, "early_payload": EARLY_S}.get(kind)
    truth = build("payload_at_20s", mass=0.5, t_s=at_s).truth if at_s else arm()
    data = record(truth, Motion(SECONDS, seed))
    q, dq, _, tau = data.true
    t = 1e-9 * data.stamp_ns
    on, add = t >= AT_S, np.zeros_like(tau)
    if kind == "coulomb_friction":
        add[:, 3] = 0.5 * np.tanh(dq[:, 3] / 0.01) * on
    elif kind == "viscous_friction":
        add[:, 2] = 0.5 * dq[:, 2] * on
    elif kind == "torque_offset":
        add[:, 1] = 0.5 * on
    elif kind == "torque_gain":
        add[:, 1] = 0.05 * tau[:, 1] * on
    elif kind == "external_wrench":
        push = RigidArm.of(panda_model()).wrench_torque(q, np.r_[FORCE_N, np.zeros(3)])
        add = -push * (on & (t < AT_S + CONTACT_S))[:, None]
    elif kind == "oscillation":  # in no catalogue
        add[:, 2] = np.sin(2 * np.pi * 3.0 * t) * on
    elif kind == "friction":
        add = FRICTION_NM * np.tanh(dq / 0.01)
    elif kind == "bristles":
        add = draw_bristles(np.random.default_rng(seed), dq.shape[1]).along(dq, 1e-3)
    return replace(data, tau=data.tau + add)


@dataclass
class Watched:
    """What a monitor said, and when on the arm's clock."""

    reports: list[dict[str, Any]]
    said: list[str]
    changes: int


def watched(data: ArmData, seed: int, rows: int = ROWS, effects: tuple[str, ...] = ()) -> Watched:
    states, said = states_of(data), []
    learner = learner_for(seed=seed, effects=effects)
    monitor = Monitor(7, None, FrontEnd(panda_model()).delay_s, said.append)
    for k in range(0, len(states), rows):
        learner.step_table(states[k : k + rows])
        monitor(learner, states[k : k + rows])
    return Watched(monitor.reports, said, len(learner.changes))


@cache
def watch(kind: str, seed: int, rows: int = ROWS, effects: tuple[str, ...] = ()) -> Watched:
    return watched(disturbed(kind, seed), seed, rows, effects)


NEW = {
    "coulomb_friction": ([4], {"Fc": 0.5}),
    "torque_offset": ([2], {"o": 0.5}),
    "viscous_friction": ([3], {"Fv": 0.5}),
    "torque_gain": ([2], {"g": 0.05}),
    "payload": ([], {"m": 0.5}),
    "external_wrench": ([], dict(zip(("fx", "fy", "fz"), FORCE_N, strict=True))),
}


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", NEW)
def test_what_is_new_is_named_within_two_seconds(kind: str, seed: int) -> None:
    """Once; a contact is over when it is, what lasts is not."""
    joints, size = NEW[kind]
    found = watch(kind, seed)
    (report,) = found.reports
    assert report["what"] == kind or kind in {x["what"] for x in report["ambiguous_with"]}
    assert report["joints"] == joints
    assert abs(report["since_s"] - AT_S) < 0.3
    assert AT_S < report["reported_s"] < AT_S + 2.0
    told = RunMessages(EstimateNames((), (), ()), None).news(9, {"findings": found.reports})
    assert told[0].fields["status"][0]["message"] == report["line"]
    assert report["line"].startswith(report["what"].replace("_", " "))
    scale = np.linalg.norm(list(size.values()))
    if report["what"] == kind:
        assert all(abs(report["size"][key] - x) < 0.1 * scale for key, x in size.items())
    if kind == "external_wrench":
        assert report["over_s"] == pytest.approx(AT_S + CONTACT_S, abs=0.15)
        assert len(found.said) == 2 and "over at" in found.said[1]
    else:
        assert report["over_s"] is None and len(found.said) == 1


@pytest.mark.parametrize(
    "kind", [pytest.param("coulomb_friction", marks=pytest.mark.slow), "payload"]
)
def test_a_learner_that_takes_each_state_alone_is_watched_as_well(kind: str) -> None:
    """As live: the learner's own alarm of a load does not interfere."""
    found = watch(kind, 1, rows=1)
    assert [report["what"] for report in found.reports] == [kind]
    assert found.changes == (kind == "payload")  # friction is no body at the hand


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_what_is_in_no_catalogue_is_unexplained(seed: int) -> None:
    report = watch("oscillation", seed).reports[0]
    assert report["what"] == "unexplained" and report["joints"] == [3]
    assert AT_S < report["reported_s"] < AT_S + 2.0


@pytest.mark.parametrize("seed", QUIET)
def test_nothing_new_nothing_said(seed: int) -> None:
    assert not watch("nothing", seed).reports


@pytest.mark.slow
def test_a_load_that_the_learner_saw_before_the_watch_began_is_told_once() -> None:
    found = watch("early_payload", 1, rows=1)
    assert found.changes == 1 and not found.reports


@pytest.mark.parametrize(
    ("kind", "effects"),
    [
        ("friction", ()),
        ("friction", ("coulomb_friction", "viscous_friction")),
        ("bristles", REAL_ARM_EFFECTS),
    ],
)
@pytest.mark.parametrize("seed", QUIET[:2])
def test_friction_that_was_always_there_is_not_new(
    kind: str, seed: int, effects: tuple[str, ...]
) -> None:
    """Learned beside θ, or left out of the model for good; with and without a memory."""
    assert not watch(kind, seed, effects=effects).reports


@pytest.mark.parametrize("seed", QUIET[:2])
def test_what_static_friction_holds_is_not_new_and_hides_no_load(seed: int) -> None:
    """From 12 s on all joints but one stand, with whatever torque their friction holds."""
    for mass in (0.0, 1.0):
        truth = build("payload_at_20s", mass=mass, t_s=AT_S).truth if mass else arm()
        data = record(truth, Motion(SECONDS, seed, alone=(3, 12.0)))
        held = draw_bristles(np.random.default_rng(seed), 7).along(data.true[1], 1e-3)
        data = replace(data, tau=data.tau + held)
        reports = watched(data, seed, effects=REAL_ARM_EFFECTS).reports
        assert bool(reports) == bool(mass)
        assert all(report["since_s"] > AT_S - 0.3 for report in reports)


def test_rests_are_not_new() -> None:
    motion = Motion(25.0, 6, rests=((8.0, 11.0), (15.0, 20.0)))
    assert not watched(record(arm(), motion), 6).reports


def test_a_replay_reports_and_a_batch_does_not_watch() -> None:
    log = disturbed("torque_offset", 1).log()
    said: list[str] = []
    exact = replay(log, panda_model(), PipelineSettings(), ReplayOptions(say=said.append)).outcome
    assert exact.disagreements is not None
    (report,) = exact.disagreements
    assert report["what"] == "torque_offset" and len(said) == 1
    assert sentence(report, 0.0).startswith("torque offset on joint 2")
    batch = replay(log, panda_model(), PipelineSettings(), ReplayOptions(every=20)).outcome
    assert batch.disagreements is None


def test_without_a_monitor_nothing_is_claimed() -> None:
    learner = learner_for(seed=1)
    learner.step_table(states_of(disturbed("nothing", 20))[:ROWS])
    assert collect(learner).disagreements is None


def test_within_a_window_friction_differs_by_its_drift_and_no_more_is_known() -> None:
    """Covariances add, whatever else is known: by the inverse of their sum."""
    root = np.random.default_rng(3).normal(size=(4, 4))
    belief = Belief(root @ root.T + np.eye(4), np.zeros(4))
    drift = np.array([0.0, 0.5, 2.0, 0.0])
    own = np.linalg.inv(np.linalg.inv(belief.H) + np.diag(drift))
    assert np.allclose(belief.widened(drift), own)
    belief.drop(slice(3, 4))  # what was known of the others goes on to fade
    belief.absorb(np.eye(3), np.ones(3), np.zeros(3), keep=0.5)
    assert np.isfinite(belief.std()).all()


def test_a_hole_ends_a_block() -> None:
    """Rows are means of 40 ms without a hole."""
    layout, blocks = StateLayout(2), Blocks(2)
    table = layout.new(100)
    stamps = 1_000_000 * np.arange(100, dtype=np.int64)
    stamps[30:] += 500_000_000
    table[:, 0] = stamps.view(np.float64)
    table[:, layout.q] = 1.0
    table[30:, layout.q] = 2.0
    (row,) = blocks.add(table)
    assert row[0] == pytest.approx(0.530 + 0.0195)
    assert row[1][:2] == pytest.approx([2.0, 2.0])
