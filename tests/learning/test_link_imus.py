"""Sensors glued on the links, anyhow: a bent Panda's axes, from Pinocchio's motion."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from adapter.errors import SettingsError
from adapter.learning.imu_schema import ImuSchema
from adapter.learning.learner import OnlineLearner
from adapter.learning.settings import LearnerSettings, SchemaSettings
from adapter.model.spatial import matrix_from_zxz
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import Outcome, learned_model
from adapter.runs.pipeline import Pipeline
from adapter.runs.replay import ReplayOptions, replay
from adapter.runs.score import Reference, schema_score
from adapter.signals.frame_topics import with_link_imus
from drivers.files.mcap import Log
from drivers.interface import DriverError
from tests.helpers.arm_data import panda_model
from tests.helpers.imu_data import Glued, axis_errors, record

LINKS = (1, 3, 6)  # links 1, 3, 5 and 6 have no sensor
SECONDS = 6.0


@cache
def _glued() -> Glued:
    return record(0, LINKS, SECONDS)


def _settings(links: tuple[str, ...]) -> PipelineSettings:
    return PipelineSettings(learner=LearnerSettings(schema=SchemaSettings(imus=links)))


def _learned(log: Log, every: int) -> Outcome:
    log, links = with_link_imus(log, panda_model())
    return replay(log, panda_model(), _settings(links), ReplayOptions(every)).outcome


@cache
def _outcome() -> Outcome:
    return _learned(_glued().log(), 10)


def test_axes_are_placed_and_lambda_says_measured() -> None:
    outcome = _outcome()
    model = learned_model(outcome, panda_model())
    assert outcome.lam_converged and outcome.lam_measured and model.lambda_source == "measured"
    errors = axis_errors(_glued().truth, matrix_from_zxz(model.lam[:, :3]), model.lam[:, 3:])
    for error, most in zip(errors, (0.1, 2.0, 2.0, 0.1), strict=True):  # deg, mm, mm, deg
        assert np.abs(error).max() < most
    start = axis_errors(_glued().truth, panda_model().joint_rotation(), panda_model().lam[:, 3:])
    assert np.abs(start[0]).max() > 1.0 and np.abs(start[1]).max() > 5.0


def test_errors_are_as_large_as_is_said() -> None:
    outcome, truth = _outcome(), _glued().truth
    reference = Reference(truth.lam, None, "truth")
    score = schema_score(outcome, panda_model(), reference, 0.0)
    assert score["source"] == "measured" and score["settled"]
    for error, std in (("rotation_error_rad", "rotation_rad"), ("position_error_m", "position_m")):
        assert (np.array(score[error]) < 4.0 * np.array(score["std"][std]) + 1e-9).all()
    shown = np.einsum("jaa->j", outcome.lam_identifiable).round()
    assert shown.tolist() == [2, 2, 4, 4, 4, 4, 4]
    assert len(score["filled"]) == 7  # of each joint's frame its place along the axis, at least


def test_what_no_sensor_shows_is_the_documentation() -> None:
    glued = replace(_glued(), sensors={k: v for k, v in _glued().sensors.items() if k < 6})
    model = learned_model(_learned(glued.log(), 10), panda_model())
    assert np.allclose(model.lam[4:], panda_model().lam[4:], atol=1e-6)
    assert not model.lam_identifiable[4:].any() and model.lam_identifiable[3].any()


def test_kept_and_restored_it_goes_on_as_before(tmp_path) -> None:
    from adapter.learning.checkpoint import load_checkpoint, save_checkpoint

    log, links = with_link_imus(_glued().log(), panda_model())
    assert links == tuple(_glued().truth.link_names[i] for i in LINKS)
    whole, first, second = (Pipeline(panda_model(), _settings(links)) for _ in range(3))
    *signals, twists, accels = (
        getattr(log, x)[:3000] for x in ("stamp_ns", "q", "dq", "tau", "twists", "accels")
    )
    table = whole.front_end.step_table(*signals, (twists, accels))
    parts = np.array_split(table, 60)
    for part in parts:
        whole.learner.learn_schema(part, 1)
    for part in parts[:40]:
        first.learner.learn_schema(part, 1)
    save_checkpoint(first.learner, tmp_path / "kept.npz")
    load_checkpoint(second.learner, tmp_path / "kept.npz")
    for part in parts[40:]:
        second.learner.learn_schema(part, 1)
    assert np.array_equal(second.learner.schema.lam, whole.learner.schema.lam)
    assert np.array_equal(second.learner.schema.information, whole.learner.schema.information)


def _told(log: Log, **options) -> str:
    with pytest.raises(DriverError) as error:
        with_link_imus(log, panda_model(), **options)
    return str(error.value)


def test_which_sensor_is_on_which_link() -> None:
    glued, names = _glued(), _glued().truth.link_names
    log = glued.log({1: "front", 3: "camera", 6: names[6]})
    found, links = with_link_imus(log, panda_model())
    assert links == (names[6],)
    assert (
        "/imu2 (front), /imu4 (camera)" in found.warnings[0] and "panda_link3" in found.warnings[0]
    )
    _, links = with_link_imus(log, panda_model(), ["/imu2=panda_link2", "/imu7"])
    assert links == (names[1], names[6])
    assert with_link_imus(log, panda_model(), ["none"]) == (log, ())
    assert "no Imu topic /imu9" in _told(log, asked=["/imu9=panda_link2"])
    assert "'elbow' is no moving link of panda" in _told(log, asked=["/imu2=elbow"])
    assert "takes: panda_link1" in _told(log, asked=["/imu2"])


def test_a_sensor_that_cannot_be_used_is_named() -> None:
    glued, names = _glued(), _glued().truth.link_names
    sensors = dict(glued.sensors)
    t_s, w, a = sensors[1]
    sensors[1] = t_s[::20], w[::20], a[::20]
    t_s, w, a = sensors[3]
    sensors[3] = t_s, np.zeros_like(w), a
    t_s, w, a = sensors[6]
    w = w.copy()
    w[100:110] = np.nan
    log = replace(glued, sensors=sensors | {6: (t_s, w, a)}).log()
    slow, still = _learned(log, 20).lam_notes
    assert f"{names[1]} reads 20 times a second, and 40 are needed" in slow
    assert f"{names[3]} always reads the same" in still


def test_a_sensor_on_another_link_is_not_believed() -> None:
    names = _glued().truth.link_names
    log = _glued().log({1: names[5], 3: names[3], 6: names[6]})
    outcome = _learned(log, 20)
    assert not outcome.lam_converged
    assert any(names[5] in note and "which link is it on" in note for note in outcome.lam_notes)


def test_settings_name_links_of_the_robot() -> None:
    robot = panda_model()
    with pytest.raises(SettingsError, match=r"no link 'elbow'.*have: panda_link1"):
        ImuSchema(robot.tree, None, SchemaSettings(imus=("elbow",)), robot.lam)
    settings = LearnerSettings(schema=SchemaSettings(imus=("panda_link3",)))
    with pytest.raises(SettingsError, match="documented λ"):
        OnlineLearner(robot.tree, robot.gravity, settings)
    with pytest.raises(SettingsError, match="twice"):
        SchemaSettings(imus=("panda_link3", "panda_link3"))
