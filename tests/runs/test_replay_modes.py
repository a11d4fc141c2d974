"""Replay: the same bits every time and as the pipeline, batches that agree, names that match."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.cli import main
from adapter.errors import SettingsError
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings
from adapter.model.spatial import log_rotation, matrix_from_zxz
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import Outcome
from adapter.runs.pipeline import Pipeline
from adapter.runs.replay import MOST_PER_UPDATE, Replay, ReplayOptions, one_after_other, replay
from adapter.runs.score import theta_score
from adapter.signals.matching import matching
from drivers.files.mcap import read_log, write_log
from drivers.interface import DriverError
from tests.helpers.arm_data import ArmData, Motion, arm, bent, panda_model, record

N = 7
NAMES = tuple(f"panda_joint{k + 1}" for k in range(N))
RECORDINGS = Path(__file__).parents[2] / "recordings"


def data(links: bool = False, seconds: float = 2.5) -> ArmData:
    truth = bent(2) if links else arm()
    found = record(truth, Motion(12.0 if not links else 4.0, 21), links=links)
    return found.part(seconds)


def settings(**learner) -> PipelineSettings:
    return PipelineSettings(learner=LearnerSettings(seed=3, **learner))


def state_bytes(learner: OnlineLearner) -> bytes:
    """Everything that a learner knows."""
    schema, theta = learner.schema, learner.theta
    parts = [schema.R0, schema.p, schema.information, theta.x, theta.mean]
    parts += [*schema.moments, *theta.moments]
    return b"".join(np.ascontiguousarray(x).tobytes() for x in parts)


@cache
def exact(links: bool = False, seconds: float = 2.5) -> Replay:
    log = matching(data(links, seconds).log(), panda_model())
    return replay(log, panda_model(), settings())


@pytest.mark.parametrize("links", [False, True])
def test_exact_replay_is_the_pipeline_sample_by_sample(links: bool) -> None:
    pipeline = Pipeline(panda_model(), settings())
    passed = sum(pipeline.step(sample) for sample in data(links).samples())
    found = exact(links)
    assert state_bytes(pipeline.learner) == state_bytes(found.pipeline.learner)
    assert pipeline.front_end.refused == found.pipeline.front_end.refused
    assert passed == found.outcome.learned
    assert found.samples == len(data(links)) == found.ticks.count
    assert 0 < found.ticks.percentile_us(50.0) <= found.ticks.summary_us()["max"]
    assert found.span_s == pytest.approx(2.499)


@pytest.mark.parametrize("links", [False, True])
def test_a_file_replays_as_what_was_recorded(tmp_path, links: bool) -> None:
    path = tmp_path / "run.mcap"
    write_log(data(links).log(), path, {})
    found = replay(matching(read_log(path), panda_model()), panda_model(), settings())
    assert state_bytes(found.pipeline.learner) == state_bytes(exact(links).pipeline.learner)
    for name in ("lam", "theta", "lam_covariance", "schema_trace", "score_trace"):
        a, b = getattr(found.outcome, name), getattr(exact(links).outcome, name)
        assert a.tobytes() == b.tobytes(), name


@cache
def batch(every: int = 10) -> Replay:
    log = matching(data(seconds=12.0).log(), panda_model())
    return replay(log, panda_model(), settings(), ReplayOptions(every=every))


def beyond_std(a: Outcome, b: Outcome) -> np.ndarray:
    """By how much what b shows of λ (n, 6) differs by more than its standard deviations."""
    turn = log_rotation(matrix_from_zxz(a.lam[:, :3]) @ matrix_from_zxz(b.lam[:, :3]).mT)
    difference = np.concatenate([turn, a.lam[:, 3:] - b.lam[:, 3:]], axis=1)
    shown = np.einsum("jab,jb->ja", b.lam_identifiable, difference)
    return np.abs(shown) - np.sqrt(np.einsum("jaa->ja", b.lam_covariance))


@pytest.mark.parametrize("every", [10, 30])
def test_batches_agree_within_the_std_as_early_and_with_fewer_steps(every: int) -> None:
    ours, theirs = batch(every), exact(seconds=12.0)
    a, b = ours.outcome, theirs.outcome
    assert a.learned == b.learned and ours.samples == theirs.samples
    assert a.lam_rank == b.lam_rank and a.lam_converged
    assert (beyond_std(a, b) <= 1e-6).all()
    k = 10 * N
    std = np.sqrt(np.diag(b.covariance)[:k]).reshape(N, 10)
    assert (np.abs(a.theta - b.theta) < std).all()
    assert converged_s(ours) < converged_s(theirs) + 0.5
    theta = ours.pipeline.learner.theta
    assert (theta.variance() < 1.001 * theta.variance(theta.least_squares())).all()
    assert ours.pipeline.learner.adam.steps < 0.8 * theirs.pipeline.learner.adam.steps


def converged_s(found: Replay) -> float:
    """When θ's torque error was that of batch least squares, for good."""
    moving_ns = found.pipeline.front_end.first_moving_ns
    return theta_score(found.outcome, panda_model(), 1e-9 * moving_ns)["converged_s"]


def test_measured_motion_in_batches() -> None:
    source = data(links=True, seconds=4.0)
    log = matching(source.log(), panda_model())
    a = replay(log, panda_model(), settings(), ReplayOptions(every=10)).outcome
    b = exact(links=True, seconds=4.0).outcome
    assert a.lam_measured and b.lam_measured
    assert (beyond_std(a, b)[2:] <= 1e-6).all()


@pytest.mark.parametrize("every", [0, -3, MOST_PER_UPDATE + 1])
def test_every_is_checked(every: int) -> None:
    with pytest.raises(SettingsError, match=f"1 to {MOST_PER_UPDATE} samples, got {every}"):
        replay(data().log(), panda_model(), settings(), ReplayOptions(every=every))


@pytest.mark.parametrize("every", [1, 10])
def test_until_s_learns_from_nothing_later(every: int) -> None:
    log = data().log()
    whole = replay(log, panda_model(), settings(), ReplayOptions(every=every, until_s=1.5))
    part = replay(data(seconds=1.5).log(), panda_model(), settings(), ReplayOptions(every=every))
    assert whole.samples == part.samples == 1500
    assert state_bytes(whole.pipeline.learner) == state_bytes(part.pipeline.learner)


def test_no_samples_are_refused() -> None:
    """None before `until_s`, and none in the recording at all."""
    log = data().log()
    nothing = log.q[:0]
    empty = replace(log, stamp_ns=log.stamp_ns[:0], q=nothing, dq=nothing, tau=nothing)
    for which, until_s in ((log, 0.0), (empty, None), (empty, 1.0)):
        with pytest.raises(DriverError, match=r"arm_data\.mcap: no samples"):
            replay(which, panda_model(), settings(), ReplayOptions(until_s=until_s))


def test_progress_is_told() -> None:
    for every in (1, 10):
        told: list[int] = []
        options = ReplayOptions(every, progress=told.append)
        replay(data().log(), panda_model(), settings(), options)
        assert told == sorted(told) and told[-1] < 2500


def test_joints_and_links_in_another_order_are_put_in_order() -> None:
    log = data(links=True).log()
    order = [3, 0, 6, 1, 5, 2, 4]
    names = tuple(log.joint_names[k] for k in order)
    parts = {key: getattr(log, key)[:, order] for key in ("q", "dq", "tau")}
    parts |= {key: getattr(log, key)[:, ::-1] for key in ("twists", "accels")}
    mixed = replace(log, joint_names=names, link_names=log.link_names[::-1], **parts)
    found = matching(mixed, panda_model())
    assert found.joint_names == panda_model().tree.joint_names
    for key in ("q", "tau", "twists", "accels"):
        assert np.array_equal(getattr(found, key), getattr(log, key))
    assert not found.warnings


def test_another_prefix_means_the_same_joints_with_a_warning() -> None:
    log = data().log()
    names = tuple(f"fer_joint{k + 1}" for k in range(N))[::-1]
    found = matching(replace(log, joint_names=names, q=log.q[:, ::-1]), panda_model())
    assert np.array_equal(found.q, log.q)
    assert len(found.warnings) == 1 and "matched by their numbers" in found.warnings[0]
    assert "fer_joint1 = panda_joint1" in found.warnings[0]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ("a b c d e f g", "panda_joint1, .*it has a, b, .*; panda"),
        ("j1 j2 j3 j4 j5 j6 k6", "panda_joint1, .*it has j1, "),
        ("x0 x1 x2 x3 x4 x5 x6", "panda_joint1, .*it has x0, "),
        (f"{' '.join(NAMES[:4])} gripper {' '.join(NAMES[5:])}", "panda_joint5; it has .*gripper"),
    ],
)
def test_names_that_say_nothing_or_lack_a_joint_are_refused(names: str, said: str) -> None:
    with pytest.raises(DriverError, match=rf"arm_data\.mcap: has no joint {said}"):
        matching(replace(data().log(), joint_names=tuple(names.split())), panda_model())


def test_extra_joints_are_ignored_with_a_warning() -> None:
    log = data().log()
    wide = {k: np.c_[np.ones(len(log)), getattr(log, k)] for k in ("q", "dq", "tau")}
    found = matching(replace(log, joint_names=("finger", *log.joint_names), **wide), panda_model())
    assert np.array_equal(found.q, log.q)
    assert len(found.warnings) == 1 and "ignored: finger" in found.warnings[0]


def test_motion_of_some_links_is_not_enough() -> None:
    log = data(links=True).log()
    part = replace(
        log, link_names=log.link_names[:5], twists=log.twists[:, :5], accels=log.accels[:, :5]
    )
    found = matching(part, panda_model())
    assert any("motion of not all links" in w for w in found.warnings)
    assert not found.link_names and found.twists.shape[1] == 0
    outcome = replay(found, panda_model(), settings()).outcome
    assert not outcome.lam_measured and np.isfinite(outcome.lam).all()


@pytest.mark.parametrize("every", [1, 10])
def test_several_recordings_are_learned_from_in_order(every: int) -> None:
    """The filter starts anew between them, the learner goes on."""
    log = matching(data(seconds=2.5).log(), panda_model())
    both = one_after_other([log, log])
    options = ReplayOptions(every=every)
    one, two = (replay(x, panda_model(), settings(), options) for x in (log, both))
    assert len(both) == 2 * len(log) == two.samples
    assert [round(length, 3) for _, length in two.pipeline.front_end.gaps] == [1.0]
    assert two.outcome.learned == pytest.approx(2 * one.outcome.learned, abs=10)
    assert one_after_other([log]).stamp_ns.tolist() == log.stamp_ns.tolist()


def test_the_recording_that_ships_replays_as_when_it_was_made(tmp_path: Path) -> None:
    out = tmp_path / "o.json"
    recording = RECORDINGS / "panda_nominal_6s.mcap"
    options = ["--quiet", "--no-report", "--out", str(tmp_path), "--json", str(out)]
    assert main(["replay", str(recording), *options]) == 0
    found = json.loads(out.read_text())
    expected = json.loads((RECORDINGS / "panda_nominal_6s.json").read_text())
    assert found["samples"] == expected["samples"] and found["learned"] == expected["learned"]
    assert found["refused"] == expected["refused"]
    # other processors round otherwise, and what no data show may then end elsewhere
    assert max(found["lambda"]["rotation_error_rad"]) < 1e-6
    ours, theirs = (x["theta"]["torque_rmse_nm"] for x in (found, expected))
    assert np.allclose(ours, theirs, rtol=0.02)
    # on its last way λ is at the edge of what counts as known, where rounding decides
    assert abs(found["lambda"]["converged_s"] - expected["lambda"]["converged_s"]) < 0.15
