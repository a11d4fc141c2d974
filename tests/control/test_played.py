"""A motion from a file is played where it may be, as it is, and within every limit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adapter.control.limits import MotionLimits
from adapter.control.played import APPROACH_S, Player
from adapter.control.settings import ExcitationSettings
from adapter.errors import SettingsError
from adapter.model.robots import documented
from adapter.signals.motion_file import read_motion
from drivers.errors import DriverError
from drivers.files.mcap import McapWriter
from sim.scenarios import build
from tests.helpers.live_tools import check_course, played

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
READY = np.array(build("nominal").truth.ready)
NAMES = PANDA.tree.joint_names
T = np.linspace(0.0, 3.0, 601)
SIDE = np.sign(-READY - 0.5)
WAY = 6.0 * (T / 3.0) ** 5 - 15.0 * (T / 3.0) ** 4 + 10.0 * (T / 3.0) ** 3
USUAL = ExcitationSettings()


def moved(rad: float, start: float = 0.05) -> Player:
    """Every joint there and back within 3 s, from near where the arm stands."""
    return Player("there.csv", T, READY + start + 4.0 * rad * np.outer(WAY * (1.0 - WAY), SIDE))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("slow_s", [0.0, 2.0])
def test_keeps_every_limit_wherever_it_stops(seed: int, slow_s: float) -> None:
    rng = np.random.default_rng(seed)
    settings = ExcitationSettings(slow_s=slow_s, share=rng.uniform(0.3, 0.9))
    motion = moved(rng.uniform(0.1, 0.8))(LIMITS, READY + rng.uniform(-0.1, 0.1, 7), settings)
    lower, upper, speed, acceleration, jerk = motion.bounds()
    check_course(motion, played(motion, rng.uniform(0.0, 14.0), 1e-3), 1e-3)
    assert (lower >= LIMITS.lower + settings.margin).all()
    assert (upper <= LIMITS.upper - settings.margin).all()
    limits = LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk
    for most, limit in zip((speed, acceleration, jerk), limits, strict=True):
        assert (most <= settings.share * limit * (1.0 + 1e-6)).all()


def test_goes_through_the_points_of_the_file_at_its_pace() -> None:
    player = moved(0.2)
    assert player.pace(LIMITS, USUAL) == pytest.approx(1.0)
    motion = player(LIMITS, READY, USUAL)
    for t, q in zip(player.t[::20], player.q[::20], strict=True):
        assert np.allclose(motion.path(APPROACH_S + t)[0], q, atol=1e-9)
    q, dq, _ = played(motion, player.seconds(LIMITS, USUAL), 1e-3)
    assert np.allclose(q[-1], player.q[-1], atol=1e-9) and not dq[-1].any()


def test_is_slowed_down_for_the_limits_and_joints_that_stand_do_not_move() -> None:
    assert 0.5 < moved(1.0).pace(LIMITS, replace(USUAL, share=0.3)) < 0.95
    motion = moved(0.2)(LIMITS, READY, replace(USUAL, move=(NAMES[3],)))
    q, _, _ = played(motion, 8.0, 1e-2)
    assert (np.ptp(q, axis=0) > 1e-9).tolist() == [j == 3 for j in range(7)]


@pytest.mark.parametrize(
    ("player", "said"),
    [
        (moved(0.2, 2.0), "takes joint 4 to"),
        (Player("deg.csv", T, np.degrees(moved(0.2).q)), "which may go from"),
        (Player("ms.csv", 1e-3 * T, moved(0.2).q), "are its times in s"),
        (Player("cut.csv", T[150:] - T[150], moved(1.0).q[150:]), "does it rest"),
    ],
)
def test_what_cannot_be_played_is_refused(player: Player, said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        player(LIMITS, READY, USUAL)


def test_a_table_and_a_trajectory_say_the_same(tmp_path: Path) -> None:
    t, q = T[::50], moved(0.3).q[::50]
    table = np.column_stack([t + 7.0, q])
    head = ",".join(["time", *(f"q_{name}" for name in NAMES)])
    np.savetxt(tmp_path / "m.csv", table, "%.12f", ",", header=head, comments="")
    with McapWriter(tmp_path / "m.mcap", NAMES[::-1]) as recording:
        points = np.stack([q, 0.0 * q, 0.0 * q], axis=1)[:, :, ::-1].copy()
        recording.write_trajectory((1e9 * t).astype(np.int64), points)
    for name in ("m.csv", "m.mcap"):
        again = read_motion(tmp_path / name, NAMES)
        assert np.allclose(again[0], t, atol=1e-8) and np.allclose(again[1], q, atol=1e-9)


def test_a_motion_that_is_none_is_refused_by_name(tmp_path: Path) -> None:
    wrong = {"short": "time,q1\n0,0\n1,0\n"}
    head = "time," + ",".join(f"q{j}" for j in range(1, 8))
    wrong["back"] = "\n".join([head, *(f"{t}{',0' * 7}" for t in (0.0, 0.2, 0.1))])
    for name, text in wrong.items():
        (path := tmp_path / f"{name}.csv").write_text(text)
        with pytest.raises(DriverError, match=name):
            read_motion(path, NAMES)
    McapWriter(tmp_path / "other.mcap", NAMES).close()
    with pytest.raises(DriverError, match="has no trajectory_msgs"):
        read_motion(tmp_path / "other.mcap", NAMES)
