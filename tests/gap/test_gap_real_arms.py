"""The gap of a real arm: a Panda's log (Gaz et al. 2019), against its model and a dummy one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet_data
import pytest

from adapter.gap.result import GapResult
from adapter.gap.workflow import GapSettings, find_gap
from tests.helpers.robot_models import real_log, shared

SPLIT_S = 14.0
BEFORE = np.array([0.28, 0.77, 0.37, 0.58, 0.34, 0.21, 0.28])  # N m, of the model as it is
AFTER = np.array([0.16, 0.26, 0.16, 0.17, 0.08, 0.05, 0.05])  # N m, at most
COULOMB = np.array([0.27, 0.20, 0.14, 0.45, 0.30, 0.15, 0.25])  # N m, of a plain fit
RUBBING = (1, 2, 4, 5, 7)
DRY = ("coulomb_friction", "bristle_friction")  # a real arm's has a memory
NEAR_NOISE = 1.6  # times the noise: no more is left without a word (1.44 on joint 1)
ROOM = 0.15  # N m by which a size may be off, and half of it: what else is named has a share


def told(model: Path) -> GapResult:
    return find_gap([real_log()], model, GapSettings(validate_from_s=SPLIT_S))


@pytest.fixture(scope="module")
def published() -> GapResult:
    """Against the model that was identified on this arm."""
    return told(shared("models/panda_gaz2019.urdf"))


def test_gap_before_is_that_of_the_recipe_and_after_is_small(published: GapResult) -> None:
    assert np.allclose(published.before.torque_rmse_nm, BEFORE, atol=0.015)
    assert (published.after.torque_rmse_nm <= AFTER).all(), published.after.torque_rmse_nm


@pytest.mark.parametrize("joint", RUBBING)
def test_friction_is_named(published: GapResult, joint: int) -> None:
    own = [f for f in published.findings if f.effect in DRY and f.joints == (joint,)]
    assert own, [(f.effect, f.joints) for f in published.findings]
    size, plain = sum(f.parameters["Fc"] for f in own), COULOMB[joint - 1]
    assert abs(size - plain) < max(ROOM, 0.5 * plain)


def test_what_is_left_is_noise_or_is_said(published: GapResult) -> None:
    """Of every joint, well over its noise before: what has no name is unexplained or doubted."""
    floor = published.noise_floor_nm
    assert (published.before.torque_rmse_nm > 2.0 * floor).all()
    said = {x.joint for x in published.unexplained}
    for x in published.unexplained:
        assert x.depends_on and x.rmse_nm > x.noise_floor_nm
    said |= {j for f in published.findings if f.overlaps or f.evidence < 0.9 for j in f.joints}
    over = published.after.torque_rmse_nm / floor
    assert {int(j) + 1 for j in np.flatnonzero(over > NEAR_NOISE)} <= said, over


@pytest.mark.slow
def test_dummy_inertias_are_said_to_be_wrong_and_no_load_is() -> None:
    urdf = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    result = told(urdf)
    told_of = [(f.effect, f.joints) for f in result.findings]
    wrong = {joint for effect, joints in told_of for joint in joints if effect == "link_inertia"}
    assert len(wrong) >= 5, told_of
    assert {"payload", "external_wrench"}.isdisjoint(dict(told_of)), told_of
    before, after = result.before.torque_rmse_nm, result.after.torque_rmse_nm
    assert np.sum(after**2) < 0.1 * np.sum(before**2), (before, after)
