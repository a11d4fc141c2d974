"""The front end in tables and single steps, on damaged recordings and random nonsense."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from adapter.signals.front_end import FrontEnd
from adapter.signals.records import LinkMotionKind, stamps_of
from tests.helpers.arm_data import ArmData, panda_model
from tests.signals.test_front_end import LAYOUT, MS, SIGNALS, N, moving, run


def damaged(links: bool) -> ArmData:
    """All that can happen, in three seconds."""
    data = moving(links)
    q, dq, tau, stamps = (np.array(x) for x in (data.q, data.dq, data.tau, data.stamp_ns))
    q[700, 2], dq[800, 1], tau[801, 0] = np.nan, np.inf, 1e9
    q[900:930], dq[900:930], tau[900:930] = q[899], dq[899], tau[899]
    stamps[1200] -= 5 * MS
    stamps[1500:] += 50 * MS
    tau[2200, 5] = 12.0
    twists = None if data.twists is None else data.twists.copy()
    if twists is not None:
        twists[1300, 4] = np.nan  # one link unheard of
        twists[2600] = np.nan
    return replace(data, q=q, dq=dq, tau=tau, stamp_ns=stamps, twists=twists)


def tables(data: ArmData, front_end: FrontEnd, cuts: list[int]) -> np.ndarray:
    """`step_table` on consecutive pieces."""
    columns = [getattr(data, name) for name in ("stamp_ns", "q", "dq", "tau")]
    motion = data.twists, data.accels
    pieces = []
    for i, j in pairwise([0, *cuts, len(data)]):
        links = None if data.twists is None else tuple(x[i:j] for x in motion)
        pieces.append(front_end.step_table(*(c[i:j] for c in columns), links))
    return np.concatenate(pieces)


@pytest.mark.parametrize("links", [False, True])
@pytest.mark.parametrize("cuts", [[], [931], [500, 905, 1501]])
def test_tables_equal_single_steps_bit_for_bit(links: bool, cuts: list[int]) -> None:
    data = damaged(links)
    single, one = run(data.samples())
    table = FrontEnd(panda_model())
    states = tables(data, table, cuts)
    assert states.tobytes() == single.tobytes()
    assert table.refused == one.refused
    assert table.first_moving_ns == one.first_moving_ns
    assert one.gaps == [(899 * MS, pytest.approx(0.031)), (1499 * MS, pytest.approx(0.051))]
    assert table.gaps == one.gaps
    assert table.messages == one.messages


@pytest.mark.parametrize("links", [False, True])
def test_a_table_that_teaches_nothing_is_empty(links: bool) -> None:
    data = moving(links).part(0.1)
    states = tables(data, FrontEnd(panda_model()), [])
    assert states.shape == (0, LAYOUT.size)


READINGS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 57.0]),
)


@settings(
    max_examples=100,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],  # shrinking 300 samples takes minutes
    suppress_health_check=list(HealthCheck),
)
@given(
    hits=st.lists(
        st.tuples(
            st.integers(0, 299),
            st.sampled_from(["q", "dq", "tau", "twist", "accel"]),
            st.integers(0, N - 1),
            READINGS,
        ),
        max_size=25,
    ),
    stamps=st.lists(st.tuples(st.integers(0, 299), st.integers(-(2**40), 2**40)), max_size=4),
    known=st.booleans(),
)
def test_nothing_that_is_no_number_ever_leaves(hits, stamps, known) -> None:
    samples = moving(links=True).samples()[1000:1300]
    for k, signal, j, value in hits:
        sample = samples[k]
        if signal in ("q", "dq", "tau"):
            row = getattr(sample, signal).copy()
            row[j] = value
            samples[k] = replace(sample, **{signal: row})
        else:
            motion = getattr(sample.links, signal).copy()
            motion[j, 2] = value
            samples[k] = replace(sample, links=replace(sample.links, **{signal: motion}))
    for k, shift in stamps:
        samples[k] = replace(samples[k], stamp_ns=samples[k].stamp_ns + shift)
    states, _ = run(samples, known)
    assert np.isfinite(states[:, SIGNALS]).all()
    learned = states[states[:, 1] != LinkMotionKind.NONE]
    assert np.isfinite(learned[:, 2:]).all()
    assert (np.diff(stamps_of(states)) > 0).all()
