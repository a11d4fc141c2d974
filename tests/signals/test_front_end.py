"""What the front end lets through: nothing bad, and the same sample by sample and in tables."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from adapter.errors import SettingsError
from adapter.model.self_model import Limits
from adapter.signals.front_end import FrontEnd
from adapter.signals.records import LinkMotionKind, StateLayout, stamps_of
from adapter.signals.settings import FrontEndSettings
from drivers.interface import DriverError, JointSample, LinkMotion
from tests.helpers.arm_data import ArmData, Motion, arm, panda_model, record

N = 7
MS = 1_000_000
LAYOUT = StateLayout(N)
SIGNALS = slice(LAYOUT.q.start, LAYOUT.tau.stop)


def moving(links: bool = False) -> ArmData:
    return record(arm(), Motion(3.0, seed=1), links=links)


def feed(front_end: FrontEnd, samples: list[JointSample]) -> np.ndarray:
    """What comes out, sample by sample; the record is reused, so it is copied at once."""
    rows = []
    for sample in samples:
        rows.extend(front_end.step(sample).copy())
    return np.array(rows).reshape(-1, LAYOUT.size)


def run(samples: list[JointSample], known: bool = True) -> tuple[np.ndarray, FrontEnd]:
    """What comes out sample by sample, of an arm with or without documented limits."""
    model = panda_model()
    front_end = FrontEnd(model if known else replace(model, limits=Limits.unknown(N)))
    states = feed(front_end, samples)
    assert len(samples) == len(states) + sum(front_end.refused.values())
    return states, front_end


def with_reading(signal: str, value: float) -> list[JointSample]:
    """Samples of motion, in one of which, at 2 s, joint 4 reads this."""
    samples = moving().samples()
    bad = getattr(samples[2000], signal).copy()
    bad[3] = value
    samples[2000] = replace(samples[2000], **{signal: bad})
    return samples


def refused_beside(front_end: FrontEnd, *usual: str) -> Counter:
    """Counts without those that every start has."""
    return Counter({k: v for k, v in front_end.refused.items() if k not in (*usual, "at_rest")})


def test_clean_motion_passes() -> None:
    data = moving()
    states, front_end = run(data.samples())
    settling = front_end.filter.gains.settle_ns / MS
    assert front_end.refused["filter_settling"] == pytest.approx(settling, abs=1)
    assert not refused_beside(front_end, "filter_settling")
    assert len(states) > 2600
    assert not front_end.gaps
    stamps = stamps_of(states)
    assert (np.diff(stamps) == MS).all()
    assert stamps[-1] == data.stamp_ns[-1] - front_end.filter.gains.delay_ns
    assert front_end.delay_s == front_end.filter.delay_s
    first = int(np.argmax((np.abs(data.dq) > 0.02).any(axis=1)))
    assert front_end.first_moving_ns == data.stamp_ns[first]


@pytest.mark.parametrize("signal", ["q", "dq", "tau"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_readings_that_are_no_numbers_are_refused(signal: str, value: float) -> None:
    states, front_end = run(with_reading(signal, value))
    assert refused_beside(front_end, "filter_settling") == {"non_finite": 1}
    said = [m for m in front_end.messages if "finite" in m]
    assert len(said) == 1 and said[0].startswith("at 2.000 s: ")
    assert np.isfinite(states).all()


@pytest.mark.parametrize(
    ("signal", "value", "said"),
    [
        ("q", -90.0, "q of panda_joint4 is -90, outside [-3.372, 0.2302]; degrees instead"),
        ("dq", 60.0, "dq of panda_joint4 is 60, outside [-6.525, 6.525]; degrees instead"),
        ("tau", 400.0, "tau of panda_joint4 is 400, outside [-261, 261]; N m?"),
        ("tau", -400.0, "tau of panda_joint4 is -400"),
        ("dq", 25.0, "dq of panda_joint4 is 25, outside"),
    ],
)
def test_readings_out_of_range_are_refused_with_a_hint(
    signal: str, value: float, said: str
) -> None:
    _, front_end = run(with_reading(signal, value))
    assert refused_beside(front_end, "filter_settling") == {"out_of_range": 1}
    assert any(m.startswith("at 2.000 s: ") and said in m for m in front_end.messages)


def test_degrees_are_refused_throughout() -> None:
    data = moving()
    degrees = replace(data, q=np.degrees(data.q), dq=np.degrees(data.dq))
    states, front_end = run(degrees.samples())
    assert not len(states)
    assert front_end.refused == {"out_of_range": len(data)}
    assert len(front_end.messages) == 1 and "degrees" in front_end.messages[0]


def test_unknown_limits_allow_anything() -> None:
    data = moving()
    states, front_end = run(
        replace(data, q=100 * data.q, tau=1e3 * data.tau).samples(), known=False
    )
    assert len(states) > 2600 and front_end.refused["out_of_range"] == 0


@pytest.mark.parametrize(("share", "stretch"), [(0.1, 1), (np.nan, 1), (0.02, 4)])
def test_an_arm_faster_than_documented_is_said_and_learned_from(share: float, stretch: int) -> None:
    """Its positions move as fast as its speeds say; three times the documented speed or not."""
    whole = moving()
    data = replace(whole, stamp_ns=whole.stamp_ns[::stretch] // stretch, q=whole.q[::stretch])
    data = replace(data, dq=stretch * whole.dq[::stretch], tau=whole.tau[::stretch])
    documented = panda_model()
    slow = replace(documented.limits, velocity=share * documented.limits.velocity)
    front_end = FrontEnd(replace(documented, limits=slow))
    feed(front_end, data.samples())
    refused = refused_beside(front_end, "filter_settling")
    assert refused["implausible_step"] < 10  # while nothing is known yet of its usual steps
    assert not refused - Counter(implausible_step=10)
    assert np.abs(data.dq).max() > (6.0 if stretch > 1 else 0.5)
    said = [m for m in front_end.messages if "faster than documented" in m]
    assert len(said) == (share > 0.0)
    assert not said or "panda_joint1" in said[0]


def test_a_refused_reading_leaves_no_trace() -> None:
    """The states of a log with a bad sample are those of the log without the sample."""
    samples = moving().samples()
    bad = list(samples)
    bad[1500] = replace(samples[1500], q=samples[1500].q * np.nan)
    bad[1700] = replace(samples[1700], tau=samples[1700].tau + 1e3)
    there, _ = run(bad)
    without, _ = run([s for i, s in enumerate(samples) if i not in (1500, 1700)])
    assert np.array_equal(there, without)


def test_repeated_samples_are_refused() -> None:
    samples = moving().samples()
    for k in range(1500, 2500, 50):
        samples[k] = replace(samples[k - 1], stamp_ns=samples[k].stamp_ns)
    states, front_end = run(samples)
    assert refused_beside(front_end, "filter_settling") == {"repeated": 20}
    assert not front_end.gaps and np.isfinite(states).all()


def test_time_running_backwards_is_refused() -> None:
    samples = moving().samples()
    samples[1500] = replace(samples[1500], stamp_ns=samples[1490].stamp_ns)
    samples[2000] = replace(samples[2000], stamp_ns=samples[1999].stamp_ns)
    states, front_end = run(samples)
    assert refused_beside(front_end, "filter_settling") == {"time_backwards": 2}
    assert (np.diff(stamps_of(states)) > 0).all()
    assert sum("time does not increase" in m for m in front_end.messages) == 1


def test_a_gap_restarts_the_filter() -> None:
    samples = moving().samples()
    before, after = samples[:2000], samples[2050:]
    states, front_end = run(before + after)
    assert front_end.gaps == [(samples[1999].stamp_ns, pytest.approx(0.051))]
    settle = front_end.filter.gains.settle_ns
    stamps = stamps_of(states) + front_end.filter.gains.delay_ns
    hole = (stamps > samples[1999].stamp_ns) & (stamps < samples[2050].stamp_ns + settle)
    assert not hole.any()
    fresh, _ = run(after)
    at = front_end.layout  # bristles remember how far they were bent before the gap
    same = np.r_[: at.bent.start, at.bent.stop : at.size]
    assert np.array_equal(states[-len(fresh) :, same], fresh[:, same])


def test_rest_teaches_nothing() -> None:
    data = record(arm(), Motion(6.0, seed=2, rests=((2.0, 5.0),)))
    states, front_end = run(data.samples())
    assert 1700 < front_end.refused["at_rest"] < 2600
    stamps = stamps_of(states) * 1e-9
    assert not ((stamps > 3.1) & (stamps < 4.9)).any()
    dq = states[:, LAYOUT.dq]
    assert (np.abs(dq).max(axis=1) >= 0.02).all()


def test_saturated_torque_is_kept_out_until_the_filter_has_forgotten_it() -> None:
    samples = moving().samples()
    for k in range(2000, 2003):  # one alone would be a spike, refused as such
        tau = samples[k].tau.copy()
        tau[6] = 12.0
        samples[k] = replace(samples[k], tau=tau)
    states, front_end = run(samples)
    wait = front_end.filter.gains.settle_ns / MS
    assert front_end.refused["torque_saturated"] == pytest.approx(wait, abs=4)
    assert front_end.refused["implausible_step"] <= 2
    stamps = stamps_of(states) + front_end.filter.gains.delay_ns
    assert not (
        (stamps >= 2000 * MS) & (stamps <= 2002 * MS + front_end.filter.gains.settle_ns)
    ).any()


def test_link_motion_is_synthesized_where_none_is_measured() -> None:
    states, _ = run(moving().samples())
    assert (states[:, 1] == LinkMotionKind.DOCUMENTED).all()
    at = LAYOUT
    assert np.array_equal(states[:, at.motion_q], states[:, at.q])
    assert np.array_equal(states[:, at.motion_dq], states[:, at.dq])


def test_measured_link_motion_takes_its_place() -> None:
    data = moving(links=True)
    states, front_end = run(data.samples())
    assert (states[:, 1] == LinkMotionKind.MEASURED).all()
    k = np.searchsorted(data.stamp_ns, stamps_of(states) + front_end.filter.gains.delay_ns)
    motion = states[:, LAYOUT.motion].reshape(-1, N, 12)
    assert np.array_equal(motion[..., :6], data.twists[k])
    assert np.array_equal(motion[..., 6:], data.accels[k])
    assert np.array_equal(states[:, LAYOUT.motion_q], data.q[k])


def test_a_link_that_was_not_heard_of_is_not_made_up() -> None:
    data = moving(links=True)
    twists = data.twists.copy()
    twists[2000:2010, 3] = np.nan
    states, _ = run(replace(data, twists=twists).samples())
    kinds = Counter(states[:, 1].tolist())
    assert kinds == {LinkMotionKind.MEASURED: len(states) - 10, LinkMotionKind.NONE: 10}


@pytest.mark.parametrize("value", [1e200, 1e6])
def test_a_spike_of_a_link_sensor_is_not_learned_from(value: float) -> None:
    """Moments never forget: one reading of 1e6 m/s would outweigh all others for good."""
    samples = moving(links=True).samples()
    twist = samples[2000].links.twist.copy()
    twist[4, 0] = value
    samples[2000] = replace(samples[2000], links=LinkMotion(twist, samples[2000].links.accel))
    states, _ = run(samples)
    learned = states[states[:, 1] == LinkMotionKind.MEASURED]
    assert np.abs(learned[:, LAYOUT.motion]).max() < 1e3


@pytest.mark.parametrize("name", list(FrontEndSettings.__dataclass_fields__))
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_settings_are_checked(name: str, value: float) -> None:
    with pytest.raises(SettingsError, match=f"front_end.{name}"):
        FrontEndSettings(**{name: value})


@pytest.mark.parametrize(
    ("stamp", "n", "said"),
    [
        (1, 2, r"has 2 positions, 2 velocities and 2 torques.*7 joints"),
        (1.5, N, r"stamp_ns .* counts whole nanoseconds"),
        (np.float64(2e9), N, r"stamp_ns .* counts whole nanoseconds"),
    ],
)
def test_a_sample_of_another_arm_or_in_seconds_is_named(stamp, n: int, said: str) -> None:
    with pytest.raises(DriverError, match=said):
        FrontEnd(panda_model()).step(JointSample(stamp, *np.zeros((3, n))))
