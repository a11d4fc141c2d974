"""Friction that winds up and torques that are late and smooth, named on recordings of Pinocchio's.

That neither is named where it is not, and that Coulomb friction stays what it is, is in `test_gap`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.effects.base import Effect as Fitted
from adapter.effects.bristle_friction import BristleFriction, StribeckFriction
from adapter.gap.result import Finding
from adapter.gap.workflow import find_gap
from sim.effects import Effect
from tests.helpers.gap_tools import believed, pinocchio_recording
from tests.hidden import draw, write


def named(effect: Effect, seed: int, folder: Path, seconds: float) -> tuple[Finding, ...]:
    """What is found of an arm with an effect; the model's inertias are 2 % off."""
    trial = replace(believed(seed), effects=(effect,), seconds=seconds)
    log, model, _ = write(trial, folder, pinocchio_recording(trial))
    return tuple(find_gap([log], model).findings)


RUBBING = {"bristle_friction", "coulomb_friction", "viscous_friction", "stribeck_friction"}
BRISTLES = [
    (5, 0.3, 1e-3, 10.0),
    pytest.param(2, 0.8, 1e-3, 20.0, marks=pytest.mark.slow),
    pytest.param(2, 0.8, 5e-3, 20.0, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("joint", "level", "way", "seconds"), BRISTLES)
def test_bristles_are_named_with_their_way(
    joint: int, level: float, way: float, seconds: float, tmp_path: Path
) -> None:
    hidden = Effect("bristle_friction", (joint,), {"Fc": level, "s0": way})
    (found,) = named(hidden, 300 + joint, tmp_path, seconds)
    assert (found.effect, found.joints) == (hidden.name, hidden.joints)
    assert found.parameters["Fc"] == pytest.approx(level, rel=0.05)
    assert found.parameters["s0"] == pytest.approx(way, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "d", "share"), [(2, 0.02, 0.75), (4, 0.015, 1.0)])
def test_a_sensors_low_pass_is_named(joint: int, d: float, share: float, tmp_path: Path) -> None:
    """`share` of d²: 1/2 is a delay, 3/4 has two equal poles, 1 is of first order."""
    hidden = Effect("torque_filter", (joint,), {"d": d, "c": share * d * d})
    (found,) = named(hidden, 300 + joint, tmp_path, 20.0)
    assert (found.effect, found.joints) == (hidden.name, hidden.joints)
    assert found.parameters["d"] == pytest.approx(d, rel=0.1)


@pytest.mark.slow
def test_what_rests_hold_is_no_effect(tmp_path: Path) -> None:
    """Static friction above Coulomb's in every joint, many rests, a tilted base."""
    trial = draw(9826, "single", "base_tilt", rubs=True)
    log, model, _ = write(trial, tmp_path, pinocchio_recording(trial))
    assert {found.effect for found in find_gap([log], model).findings} <= {*RUBBING, "base_tilt"}


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "effect"), [(9932, "bristle"), (9902, "stribeck")])
def test_a_finer_friction_is_not_given_up_for_coulombs(seed, effect, tmp_path: Path) -> None:
    """Under its own weights Coulomb friction explains as much, under Coulomb's it does not."""
    trial = draw(seed, "single", f"{effect}_friction")
    log, model, _ = write(trial, tmp_path, pinocchio_recording(trial))
    (found,) = find_gap([log], model).findings
    assert (found.effect, found.joints) == (f"{effect}_friction", trial.effects[0].joints)


@pytest.mark.slow
def test_friction_that_falls_with_the_speed_is_no_law(tmp_path: Path) -> None:
    """LuGre's in every joint; that of the sixth was taken for dq times a curve over q."""
    trial = draw(31052, "single")
    log, model, _ = write(trial, tmp_path, pinocchio_recording(trial))
    found = {(x.effect, x.joints): x.parameters for x in find_gap([log], model).findings}
    assert trial.friction is not None and not any(name.startswith("law") for name, _ in found)
    falls = found["stribeck_friction", (6,)]
    assert falls["Fc"] == pytest.approx(trial.friction.coulomb[5], rel=0.1)
    assert falls["Fs"] == pytest.approx(trial.friction.stiction[5], rel=0.1)


@pytest.mark.parametrize("ratio", [1e-9, 1e9])
@pytest.mark.parametrize(("effect", "key"), [(BristleFriction(), "s0"), (StribeckFriction(), "vs")])
def test_a_search_for_another_shape_stays_among_those_that_may_be(
    effect: Fitted, key: str, ratio: float
) -> None:
    (told,) = effect.reshaped({"Fc": 0.3, "Fs": 0.4, key: 1e-2}, ratio)
    bounds = next(p for p in effect.parameters if p.key == key)
    assert bounds.lower <= told.decode(np.array([0.3, 0.4]))[key] <= bounds.upper
