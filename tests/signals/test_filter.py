"""The joint filter against filterpy's Kalman filter, scipy's linear systems and the moving arm."""

import numpy as np
import pinocchio as pin
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from scipy.signal import csd, lsim

from adapter.errors import SettingsError
from adapter.signals.filters import (
    NEVER,
    FilterState,
    JointFilter,
    filter_step,
    noise_from_samples,
    steady_state_poles,
)
from adapter.signals.settings import FilterSettings
from sim.scenarios import build
from tests.helpers.arm_data import pin_model, rnea

PERIOD_NS = 1_000_000
BANDWIDTHS = (3.0, 6.0, 10.0, 25.0)


def run(joint_filter: JointFilter, stamps_ns, signals) -> tuple[np.ndarray, np.ndarray]:
    """Outputs y, dy (m, 3 n) after every sample of signals (m, 3 n)."""
    y, dy, state = np.empty_like(signals), np.empty_like(signals), fresh(signals.shape[1])
    for i, (stamp, row) in enumerate(zip(stamps_ns, signals, strict=True)):
        filter_step(int(stamp), row, joint_filter.gains, state)
        y[i], dy[i] = state.y, state.dy
    return y, dy


def fresh(size: int) -> FilterState:
    """What a filter of so many signals remembers before its first sample."""
    return FilterState(np.array([NEVER, NEVER]), *np.zeros((3, size)))


def transfer(joint_filter: JointFilter, hz: np.ndarray) -> np.ndarray:
    """L(s) at these frequencies."""
    s = 2j * np.pi * np.asarray(hz)
    return joint_filter.gains.k2 / (s * s + joint_filter.gains.k1 * s + joint_filter.gains.k2)


@pytest.mark.parametrize("settings", [*map(FilterSettings, BANDWIDTHS), FilterSettings(dq_drive=2)])
def test_poles_are_those_of_filterpys_steady_state(settings: FilterSettings) -> None:
    """A Kalman filter runs on a signal; once settled, its errors decay with L's poles."""
    T, noise = settings.period_s, settings.dq_noise or 5e-3
    drive = settings.dq_drive
    if drive is None:
        drive = (2 * np.pi * settings.bandwidth_hz) ** 2 * noise * np.sqrt(T)
    filters = []
    for start in (0.0, 1.0):
        kalman = KalmanFilter(dim_x=2, dim_z=1)
        kalman.F, kalman.H = np.array([[1.0, T], [0.0, 1.0]]), np.array([[1.0, 0.0]])
        kalman.R *= noise**2
        kalman.Q = Q_continuous_white_noise(2, dt=T, spectral_density=drive**2)
        kalman.P = np.diag([noise**2, drive**2])
        kalman.x = np.zeros((2, 1))
        filters.append(kalman)
        for k in range(3000):
            if k == 2000:  # settled: from here on, one of them is put off
                kalman.x[0, 0] += start
            kalman.predict()
            kalman.update(np.sin(0.01 * k))
            if k >= 2000:
                kalman.kept = [*getattr(kalman, "kept", []), kalman.x[0, 0]]
    error = np.subtract(filters[1].kept, filters[0].kept)[:60]
    # e[k+2] + a e[k+1] + b e[k] = 0 has the poles as its roots
    a, b = np.linalg.lstsq(np.c_[error[1:-1], error[:-2]], -error[2:], rcond=None)[0]
    poles = np.log(np.roots([1.0, a, b]).astype(complex)) / T
    k1, k2 = steady_state_poles(settings)
    assert k1 == pytest.approx(-poles.sum().real, rel=1e-6)
    assert k2 == pytest.approx(poles.prod().real, rel=1e-6)


@pytest.mark.parametrize("hz", BANDWIDTHS)
def test_the_corner_is_where_it_was_asked_for(hz: float) -> None:
    joint_filter = JointFilter(FilterSettings(hz))
    gain = np.abs(transfer(joint_filter, [hz]))[0]
    assert 20 * np.log10(gain) == pytest.approx(-3.0, abs=0.3)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("hz", BANDWIDTHS)
def test_integration_is_exact_at_jittered_stamps(hz: float, seed: int) -> None:
    """lsim with first-order hold on a grid of 10 us that all stamps lie on."""
    rng = np.random.default_rng(seed)
    ticks = np.cumsum(rng.integers(20, 220, size=120))
    ticks -= ticks[0]
    signals = np.cumsum(rng.normal(size=(len(ticks), 3)), axis=0)
    joint_filter = JointFilter(FilterSettings(hz))
    y, dy = run(joint_filter, 10_000 * ticks, signals)
    grid = np.arange(ticks[-1] + 1)
    k1, k2 = joint_filter.gains.k1, joint_filter.gains.k2
    system = (
        np.array([[0.0, 1.0], [-k2, -k1]]),
        np.array([[0.0], [k2]]),
        np.eye(2),
        np.zeros((2, 1)),
    )
    for c in range(3):
        u = np.interp(grid, ticks, signals[:, c])
        _, out, _ = lsim(system, u, 1e-5 * grid, X0=[u[0], 0.0], interp=True)
        assert np.abs(y[:, c] - out[ticks, 0]).max() < 1e-9 * np.abs(u).max()
        assert np.abs(dy[:, c] - out[ticks, 1]).max() < 1e-9 * np.abs(out[:, 1]).max()


@pytest.mark.parametrize("seed", range(3))
def test_repeated_and_missing_samples_change_nothing_on_a_straight_line(seed: int) -> None:
    """y is the line as it was delay_s ago, whichever samples arrive."""
    rng = np.random.default_rng(seed)
    joint_filter = JointFilter()
    stamps = PERIOD_NS * np.sort(rng.choice(3000, size=1200, replace=False))
    stamps[1:] += rng.integers(-400_000, 400_000, size=1199)
    stamps = np.sort(stamps)
    slope, start = rng.normal(size=(2, 3))
    y, dy = run(joint_filter, stamps, start + slope * 1e-9 * stamps[:, None])
    late = stamps > stamps[0] + 1e9
    then = 1e-9 * stamps[late, None] - joint_filter.delay_s
    assert np.abs(y[late] - (start + slope * then)).max() < 1e-9
    assert np.abs(dy[late] - slope).max() < 1e-9


def test_start_and_reset_settle_at_rest() -> None:
    gains, state = JointFilter().gains, fresh(3)
    u = np.array([0.3, 0.0, 5.0])
    settled = [filter_step(PERIOD_NS * k, u, gains, state) for k in range(400)]
    assert np.allclose(state.y, u, rtol=1e-14) and np.abs(state.dy).max() < 1e-10
    assert settled.index(True) == pytest.approx(1e3 * gains.settle_ns * 1e-9, abs=1)
    state.times[0] = NEVER
    assert not filter_step(10**9, 2 * u, gains, state)
    assert np.array_equal(state.y, 2 * u)


@pytest.fixture(scope="module")
def moving_arm() -> tuple[np.ndarray, ...]:
    """Stamps, signals (m, 3 n) of the simulated arm without noise, on sines up to 5 Hz.

    The sines are small: products of fast signals pass no filter as they are, and would hide
    microseconds between the signals themselves.
    """
    plant = build("nominal", noise="none").plant()
    model = pin_model(plant.truth)
    data, rng = model.createData(), np.random.default_rng(4)
    w = 2 * np.pi * np.array([0.4, 1.3, 3.1, 5.0])[:, None]
    size = 0.02 * rng.uniform(0.6, 1.0, (4, 7)) / w
    phase = rng.uniform(0, 2 * np.pi, (4, 7))
    stamps, rows = [], []
    for k in range(9000):
        plant.read()
        sample = plant.clean()
        stamps.append(sample.stamp_ns)
        rows.append(np.concatenate([sample.q, sample.dq, sample.tau]))
        t = (k + 1) * 1e-3
        on = min(t, 1.0)
        want = plant.truth.ready + on * (size * (np.sin(w * t + phase) - np.sin(phase))).sum(0)
        speed = on * (size * w * np.cos(w * t + phase)).sum(0)
        gravity = pin.rnea(model, data, sample.q, np.zeros(7), np.zeros(7))
        inertia = pin.crba(model, data, sample.q)
        push = 400.0 * (want - sample.q) + 40.0 * (speed - sample.dq)
        plant.command(gravity + inertia @ push)
    assert plant.fault is None
    plant.close()
    return np.array(stamps), np.array(rows)


def lags(expected: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Lag (s) of `found` behind `expected` around 0.4, 1.3, 3.1 and 5 Hz by power, (4, n)."""
    options = {"fs": 1000.0, "nperseg": 4000, "axis": 0}
    f, cross = csd(expected, found, **options)
    power = csd(expected, expected, **options)[1].real
    shift = -np.angle(cross) / (2 * np.pi * np.maximum(f, 0.1))[:, None]
    bands = [(f >= low) & (f < high) for low, high in ((0.2, 0.8), (0.8, 2), (2, 4), (4, 5.6))]
    return np.array([(power * shift)[b].sum(axis=0) / power[b].sum(axis=0) for b in bands])


@pytest.mark.parametrize("hz", [6.0, 10.0])
def test_tau_and_ddq_belong_to_one_instant(moving_arm, hz: float) -> None:
    """Inverse dynamics of the filtered q, dq, ddq is the filtered tau: phase below 0.2 ms."""
    stamps, rows = moving_arm
    y, dy = run(JointFilter(FilterSettings(hz)), stamps, rows)
    q, dq, tau = np.split(y, 3, axis=1)
    expected = rnea(pin_model(build("nominal").truth), q, dq, dy[:, 7:14])
    late = slice(1500, None)
    assert np.abs(lags(expected[late], tau[late])).max() < 2e-4
    # half a sample would not pass
    assert np.abs(lags(expected[late], tau[1500 - 1 : -1])).min() > 5e-4
    error = tau[late] - expected[late]
    assert (error.std(axis=0) < 0.02 * (tau[late].std(axis=0))).all()


def test_noise_gain_is_the_variance_ratio() -> None:
    """White noise keeps 1 / noise_gain of its variance."""
    rng = np.random.default_rng(1)
    joint_filter = JointFilter()
    y, _ = run(joint_filter, PERIOD_NS * np.arange(20_000), rng.normal(size=(20_000, 24)))
    assert y[500:].var() * joint_filter.noise_gain == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_told_from_motion(seed: int) -> None:
    with pytest.raises(SettingsError, match="at least 8 samples, got 7"):
        noise_from_samples(np.zeros((7, 2)))
    rng = np.random.default_rng(seed)
    t = 1e-3 * np.arange(5000)[:, None]
    motion = np.sin(2 * np.pi * np.array([0.5, 1.0, 2.0]) * t) * 1.5
    level = np.array([1e-4, 5e-3, 0.2])
    found = noise_from_samples(motion + level * rng.normal(size=motion.shape))
    assert np.abs(found / level - 1).max() < 0.05


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"bandwidth_hz": 0.0}, "bandwidth_hz"),
        ({"bandwidth_hz": np.nan}, "bandwidth_hz"),
        ({"bandwidth_hz": 200.0}, "1000 samples a second; at most 100"),
        ({"dq_noise": -1.0}, "dq_noise"),
        ({"dq_drive": 0.0}, "dq_drive"),
        ({"period_s": 0.0}, "period_s"),
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(SettingsError, match=said):
        FilterSettings(**wrong)
