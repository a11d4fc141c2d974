"""The timing check finds what was done to a recording's clock, and nothing where nothing was."""

import numpy as np
import pytest

from adapter.screening.timing import check_timing, uniform
from tests.helpers.arm_data import Motion, trajectory
from tests.helpers.robot_models import real_log

Signals = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def recording(
    seed: int, late_s: float = 0.0, seconds: float = 20.0, rate_hz: int = 1000, high_hz: float = 1.0
) -> Signals:
    """Stamps, q, dq, tau of a moving arm whose dq is late; noise as on a Panda."""
    q, dq, _ = trajectory(Motion(seconds, seed, high_hz=high_hz))
    t = 1e-3 * np.arange(len(q))
    dq = np.column_stack([np.interp(t - late_s, t, x) for x in dq.T])
    rng = np.random.default_rng([seed, 3])
    pick = slice(None, None, 1000 // rate_hz)
    q = (q + 3e-4 * rng.normal(size=q.shape))[pick]
    dq = (dq + 5e-3 * rng.normal(size=dq.shape))[pick]
    stamps = (1_000_000_000 // rate_hz) * np.arange(len(q), dtype=np.int64)
    return stamps, q, dq, rng.normal(size=q.shape)


@pytest.mark.parametrize("late_ms", [0.0, 0.25, 0.5, 5.3, -2.0])
@pytest.mark.parametrize("seed", range(5))
def test_lateness(seed: int, late_ms: float) -> None:
    timing = check_timing(*recording(seed, 1e-3 * late_ms))
    error = abs(timing.lateness_s - 1e-3 * late_ms)
    assert error < 3e-5 and error < 5 * timing.lateness_std_s
    assert timing.lateness_std_s < 2e-5
    np.testing.assert_allclose(timing.velocity_gain, 1.0, atol=2e-3)
    said = " ".join(timing.words())
    assert ("dq is" in said) == (late_ms != 0.0) == (said != "")
    assert timing.kept == timing.samples == 20_000 and timing.jitter_s < 1e-9
    assert ("half a sample" in said) == (late_ms == 0.5)


@pytest.mark.parametrize("rate_hz", [100, 250, 500])
def test_lateness_at_other_rates_in_slow_motion(rate_hz: int) -> None:
    timing = check_timing(*recording(3, 5e-3, rate_hz=rate_hz, high_hz=0.3))
    assert timing.rate_hz == pytest.approx(rate_hz)
    assert abs(timing.lateness_s - 5e-3) < 6e-4


def test_holes_repeats_and_stamps_out_of_order() -> None:
    stamps, q, dq, tau = (x.copy() for x in recording(2, 1e-3))
    for x in (q, dq, tau):
        x[1000:19_000:20] = x[999:18_999:20]  # 900 of them
    stamps[7500] = stamps[-1] + 10**12  # far ahead
    stamps[12_000] = stamps[11_990]
    q[15_000, 2] = np.nan
    gone = np.arange(5000, 5060)
    signals = tuple(np.delete(x, gone, axis=0) for x in (stamps, q, dq, tau))
    timing = check_timing(*signals)  # type: ignore[arg-type]
    assert len(timing.holes) == 1
    assert timing.holes[0] == pytest.approx((4.999, 0.061))
    assert timing.repeated == pytest.approx(897 / 19_940, abs=1e-3)
    assert timing.out_of_order == 2 and timing.not_finite == 1
    assert timing.lateness_s == pytest.approx(1e-3, abs=5e-5)
    said = " ".join(timing.words())
    for word in ("hole", "repeat", "do not increase", "no number"):
        assert word in said
    rows = uniform(*signals)  # type: ignore[arg-type]
    assert (np.diff(signals[0][rows]) > 0).all()
    assert np.isfinite(signals[1][rows]).all()
    assert len(rows) == timing.kept > 18_900


@pytest.mark.parametrize("signal", ["q", "tau"])
def test_a_signal_held_for_several_samples(signal: str) -> None:
    stamps, q, dq, tau = recording(4)
    held = np.arange(len(q)) // 4 * 4
    q, tau = (x[held] if name == signal else x for name, x in (("q", q), ("tau", tau)))
    timing = check_timing(stamps, q, dq, tau)
    assert timing.held[signal] == pytest.approx(0.75, abs=0.01)
    assert timing.hold_lag_s(signal) == pytest.approx(1.5e-3, rel=0.05)
    assert any(s.startswith(f"{signal} is updated at 250 Hz") for s in timing.words())


def test_a_simulated_arm_at_rest_repeats_nothing() -> None:
    stamps, q, dq, tau = (x.copy() for x in recording(5))
    q[:3000], dq[:3000], tau[:3000] = q[3000], 0.0, tau[3000]
    timing = check_timing(stamps, q, dq, tau)
    assert timing.repeated == 0.0 and timing.frozen == ()


def test_a_stuck_source() -> None:
    stamps, q, dq, tau = (x.copy() for x in recording(6))
    for x in (q, dq, tau):
        x[9000:9200] = x[9000]
    timing = check_timing(stamps, q, dq, tau)
    assert timing.frozen == (pytest.approx((9.0, 0.199), abs=2e-3),)


@pytest.mark.parametrize("m", [0, 1, 2, 50])
def test_short_recordings(m: int) -> None:
    stamps, q, dq, tau = (x[:m] for x in recording(0))
    timing = check_timing(stamps, q, dq, tau)
    assert timing.samples == m and timing.lateness_s != 0.0
    timing.words()


def test_a_real_log() -> None:
    log = real_log()
    timing = check_timing(log.stamp_ns, log.q, log.dq, log.tau)
    assert timing.rate_hz == pytest.approx(1000, rel=0.01)
    assert timing.repeated == pytest.approx(0.055, abs=0.002)
    assert timing.lateness_s == pytest.approx(5.37e-3, abs=1e-4)
    assert len(timing.holes) == 4
