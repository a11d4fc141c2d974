"""The DBC file and the codec say the same of every frame."""

from pathlib import Path

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import drivers.damiao
from drivers.damiao import codec
from drivers.damiao.tables import MOTOR_TYPES, OPENARM

DBC = cantools.database.load_file(Path(drivers.damiao.__file__).with_name("damiao.dbc"))
JOINTS = st.integers(1, 7)


def limits_of(joint):
    return MOTOR_TYPES[OPENARM[joint - 1]]


def test_ids():
    ids = {message.frame_id: message.name for message in DBC.messages}
    assert ids == {j: f"Command{j}" for j in range(1, 8)} | {
        0x10 + j: f"State{j}" for j in range(1, 8)
    }


@settings(max_examples=100, deadline=None)
@given(
    JOINTS,
    st.integers(0, 65535),
    *[st.integers(0, 4095)] * 2,
    st.integers(0, 15),
    *[st.integers(0, 255)] * 2,
)
def test_we_read_cantools_states(joint, q, dq, tau, status, mosfet, rotor):
    codes = {"Status": status, "Motor": joint, "Q": q, "Dq": dq, "Tau": tau}
    codes |= {"Mosfet": mosfet, "Rotor": rotor}
    data = DBC.encode_message(0x10 + joint, codes, scaling=False)
    ours = codec.state(limits_of(joint), data)
    theirs = DBC.decode_message(0x10 + joint, data, decode_choices=False)
    assert (ours.status, ours.motor) == (theirs["Status"], theirs["Motor"])
    for mine, name in ((ours.q, "Q"), (ours.dq, "Dq"), (ours.tau, "Tau")):
        assert mine == pytest.approx(theirs[name], abs=1e-9)
    assert ours.mosfet_degc % 256 == theirs["Mosfet"]
    assert ours.rotor_degc % 256 == theirs["Rotor"]


@settings(max_examples=100, deadline=None)
@given(JOINTS, st.integers(0, 65535), *[st.integers(0, 4095)] * 4)
def test_cantools_commands_are_ours_code_by_code(joint, q, dq, kp, kd, tau):
    codes = {"Q": q, "Dq": dq, "Kp": kp, "Kd": kd, "Tau": tau}
    data = DBC.encode_message(joint, codes, scaling=False)
    word = q << 48 | dq << 36 | kp << 24 | kd << 12 | tau
    assert data == word.to_bytes(8, "big")
    limits, half = limits_of(joint), 1e-6
    ours = codec.mit_command(
        limits,
        codec.value_of(q, -limits.q_max, limits.q_max, 65535) + half * limits.q_max / 65535,
        codec.value_of(dq, -limits.dq_max, limits.dq_max, 4095) + half * limits.dq_max / 4095,
        codec.value_of(kp, 0.0, 500.0, 4095) + half * 500 / 4095,
        codec.value_of(kd, 0.0, 5.0, 4095) + half * 5 / 4095,
        codec.value_of(tau, -limits.tau_max, limits.tau_max, 4095) + half * limits.tau_max / 4095,
    )
    if data[:7] != b"\xff" * 7:
        assert ours == data
