"""Several recordings of one arm: one model, a load of its own each, and the odd one out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from adapter.gap import workflow
from adapter.gap.fit import Fit, Model, place_of
from adapter.gap.load import hand_frame
from adapter.gap.several import Part, Several, Together
from adapter.gap.signals import Recorded, prepare
from adapter.gap.workflow import names_of
from adapter.judgement.priors import theta_prior
from adapter.physics.rigid_arm import RigidArm
from drivers.files.mcap import Log
from sim.effects import Effect, payload, per_joint
from tests.helpers.arm_data import Motion, arm, panda_model, record
from tests.helpers.twin_makers import by_pinocchio
from tests.hidden.twins import draw_twin

FRICTION = np.array([0.3, 0.4, 0.25, 0.35, 0.2, 0.15, 0.1])
LOADS_KG = (0.0, 0.6, 1.1, 0.6, 2.4)


def several(logs: Sequence[Log], share: float = 0.02) -> Several:
    """The documented Panda on recordings, fitted together."""
    body = RigidArm.of(panda_model())
    signals = tuple(prepare(Recorded.of(log), body) for log in logs)
    nominal = Fit(Model(signals, np.zeros_like(body.theta)), theta_prior(body.theta, share))
    names = [f"{k}.mcap" for k in range(len(logs))]
    return Several.of(nominal, names, hand_frame(panda_model()))


def rubbing(times: float = 1.0) -> list[Effect]:
    return [
        *per_joint("coulomb_friction", "Fc", (times * FRICTION).tolist()),
        *per_joint("viscous_friction", "Fv", (0.2 * times * FRICTION).tolist()),
    ]


def recorded(k: int, load_kg: float, times: float = 1.0, link_kg: float = 0.0) -> Log:
    """3 s of an arm with some friction, with so much at the hand and so much more in link 4."""
    rng = np.random.default_rng(11)
    theta = arm().theta * rng.normal(1.0, 0.05, (7, 1))
    theta[3, 0] += link_kg
    theta[3, 1:4] += link_kg * np.array([0.0, 0.05, 0.1])
    held = [payload(load_kg, np.array([0.0, 0.02, 0.15]), 2e-3 * np.eye(3))] if load_kg else []
    changed = arm().with_changes(theta=theta, effects=[*rubbing(times), *held])
    return record(changed, Motion(3.0, 40 + k)).log()


@cache
def logs() -> tuple[Log, ...]:
    return tuple(recorded(k, load) for k, load in enumerate(LOADS_KG))


def test_masses_are_right_and_equal_ones_agree() -> None:
    found = several(logs())
    mass = np.array([load.mass for load in found.loads])
    std = np.array([load.mass_std for load in found.loads])
    assert (np.abs(mass - LOADS_KG) < 4.0 * std).all() and (std < 0.3).all()
    np.testing.assert_allclose(np.diff(mass), np.diff(LOADS_KG), atol=0.06)
    assert not found.same_load and found.odd == []


def test_recording_by_recording_is_what_all_at_once_gives() -> None:
    """The Schur complements against one least squares over all coefficients."""
    fits = several(logs()[:2]).fits
    load, *beside = fits[0].named
    named = (load, replace(fits[1].named[0], recording=1), *beside)
    recordings = tuple(fit.recordings[0] for fit in fits)
    model = replace(fits[0].model, recordings=recordings, named=named)
    whole = replace(fits[0], model=model)
    whole = replace(whole, noise=tuple(fit.noise[0] for fit in fits))
    carried = replace(whole, doubts=tuple(fit.doubts[0] for fit in fits)).carried()
    held, last = fits[0].dtheta.size + 1, place_of(fits[0], 0)[-1]  # then the load
    parts = [Part.of(fit, np.arange(held, last + 1)) for fit in fits]
    together = Together(
        parts, np.delete(whole.prior_std, np.arange(held, place_of(whole, 1)[-1] + 1))
    )
    for k, part in enumerate(parts):
        load = part.own_at(together.x)[-10:]
        np.testing.assert_allclose(load, carried.x[place_of(whole, k)], rtol=1e-6, atol=1e-9)


def test_the_same_load_in_all_is_common() -> None:
    found = several([recorded(k, 1.2) for k in range(3)])
    assert found.same_load
    start = found.started(found.fits[0])
    assert [e.recording for e in start.named] == [None]


@pytest.mark.parametrize(
    ("change", "what"),
    [({"times": 1.3}, "friction"), ({"link_kg": 1.0}, "link")],
    ids=["30 % more friction", "1 kg in link 4"],
)
def test_a_recording_of_another_arm_is_named(change: dict[str, float], what: str) -> None:
    odd = recorded(2, LOADS_KG[2], **change)
    found = several([*logs()[:2], odd, *logs()[3:]])
    assert [x.recording for x in found.odd] == [2]
    assert found.odd[0].kind == what, found.odd


def test_pairs_of_twins_of_real_logs_agree() -> None:
    """Two motions, five loads: each weighed twice, up to what wrong links shift all of them by."""
    twins = [draw_twin(1, motion, load) for motion in range(2) for load in range(5)]
    found = several([by_pinocchio(twin) for twin in twins])
    mass = np.array([load.mass for load in found.loads]).reshape(2, 5)
    assert np.median(np.abs(mass[0] - mass[1])) < 0.2
    true = np.array([twin.load_kg for twin in twins])
    std = np.array([load.mass_std for load in found.loads])
    off = mass.ravel() - true
    assert (np.abs(off - np.median(off)) < 4.0 * std).all() and abs(np.median(off)) < 0.5
    assert found.odd == []


def test_of_many_those_in_which_most_moves_are_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workflow, "SEARCHED_S", 5.0)
    found = workflow.find_gap(logs()[1:4], panda_model())
    assert sum("searched, and scored by blocks" in note for note in found.notes) == 1
    assert len(found.loads) == 3 and len(found.recordings) == 2


def test_names_tell_recordings_apart() -> None:
    assert names_of(["a/x.mcap", "b/y.mcap"]) == ["x.mcap", "y.mcap"]
    assert names_of([Path("a/x.mcap"), "b/x.mcap"]) == ["a/x.mcap", "b/x.mcap"]
    assert names_of(["x.mcap", "x.mcap"]) == ["x.mcap", "x.mcap (2)"]
