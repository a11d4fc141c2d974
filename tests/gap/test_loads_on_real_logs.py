"""Loads on a real Panda: unknown ones, and known ones added to its log (Gaz et al. 2019)."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pinocchio as pin
import pybullet_data
import pytest
from scipy.signal import butter, sosfiltfilt

from adapter.effects.robots import read_robot
from adapter.gap.load import find_load
from adapter.gap.real_arm import RealArm, nominal_fit, real_arm
from adapter.gap.signals import Recorded
from adapter.model.self_model import SelfModel
from adapter.runs.library import make_log
from adapter.screening.screen import refuse
from adapter.screening.timing import lateness
from drivers.files.mcap import Log
from sim.truth import panda
from tests.helpers.gap_effects import regressor
from tests.helpers.robot_models import real_log
from tests.hidden.trial import nominal_urdf

DATA = Path(__file__).parents[2].parent / "shared" / "data" / "panda_gaz2019"
pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the folder of real logs is not beside the project"
)
PIECES_S = ((0.5, 4.5), (6.0, 10.0), (12.0, 15.5), (16.0, 20.0))
LOADS_KG = (0.0, 1.2, 2.5, 4.0)
BAND_HZ = 15.0
PRIOR = 0.02
CENTRE_M, HALF_M = np.array([0.01, -0.02, 0.17]), 0.04  # in the last link's frame; of a cube


def loaded(mass: float, piece: tuple[float, float]) -> Log:
    """A piece of the log, with what a cube of so many kg adds to the torques."""
    log = real_log()
    t, q, tau = 1e-9 * log.stamp_ns, log.q, log.tau
    grid = np.arange(t[0], t[-1], 1e-3)
    low = butter(2, BAND_HZ, fs=1000, output="sos")
    way = sosfiltfilt(low, np.column_stack([np.interp(grid, t, x) for x in q.T]), axis=0)
    speed = np.gradient(way, 1e-3, axis=0)
    own = HALF_M**2 * 2 / 3 * np.eye(3) + CENTRE_M @ CENTRE_M * np.eye(3)
    inertia = (own - np.outer(CENTRE_M, CENTRE_M))[np.triu_indices(3)]
    body = mass * np.concatenate([[1.0], CENTRE_M, inertia])
    more = regressor(panda(), way, speed, np.gradient(speed, 1e-3, axis=0))[:, :, -10:] @ body
    tau = tau + np.column_stack([np.interp(t, grid, x) for x in more.T])
    on = (t >= piece[0]) & (t < piece[1])
    return replace(log.take(on), tau=tau[on])


def weighed(log: Log, model: SelfModel) -> RealArm:
    screened = refuse(log, model)
    own = Recorded.of(screened.log, lateness(screened.timing))
    return real_arm(
        nominal_fit([own], model, PRIOR, screened.timing.period_s), screened.moving, (0,)
    )


def test_loads_are_weighed_and_a_bare_hand_is_bare(tmp_path: Path) -> None:
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(nominal_urdf(panda()))
    model = read_robot(str(urdf))
    for mass, piece in zip(LOADS_KG, PIECES_S, strict=True):
        arm = weighed(loaded(mass, piece), model)
        assert arm.is_there(0) is (mass > 0.0), mass
        assert abs(arm.fit.named[0].x[0] - mass) < 0.3, mass


@pytest.mark.filterwarnings("ignore::adapter.errors.ModelWarning")
def test_a_load_is_told_from_inertias_that_somebody_made_up() -> None:
    """Those of PyBullet's Panda: a heavier last link would explain as much."""
    model = read_robot(str(Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"))
    arm = weighed(loaded(4.0, PIECES_S[3]), model)
    assert arm.is_there(0)
    assert abs(arm.fit.named[0].x[0] - 4.0) < 3.0 * arm.mass_std[0] < 2.0


def test_unknown_loads_are_those_of_plain_least_squares() -> None:
    """Every fourth of 40 short logs, against the shared tool: Pinocchio, white noise, no search."""
    shared = DATA.parents[1]
    spec = spec_from_file_location("plain_load", shared / "tools" / "plain_load.py")
    plain = module_from_spec(spec)
    spec.loader.exec_module(plain)
    urdf = shared / "models" / "panda_gaz2019_hand.urdf"
    arm, model = pin.buildModelFromUrdf(str(urdf)), read_robot(str(urdf))
    for path in sorted((DATA.parent / "panda_unknown_loads").glob("*.npz"))[::4]:
        t, q, dq, tau = (np.load(path)[key].astype(float) for key in ("time", "q", "dq", "tau"))
        mass, *_ = plain.load(arm, plain.rows(t, q, dq, tau))
        later = np.concatenate([[True], np.diff(t) > 0.0])
        log = make_log(*(x[later] for x in (t, q, dq, tau)), joint_names=model.tree.joint_names)
        found = find_load(log, model)
        assert abs(found.mass - mass) < min(0.3, 3.0 * found.mass_std), path.name
        assert found.mass_std < 0.3
