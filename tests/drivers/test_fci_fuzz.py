"""Whatever bytes arrive, the FCI decoders answer with a value or a WireError."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.fci import codec, tables
from drivers.fci.codec import StateDecoder, WireError
from tests.helpers import fci_peer
from tests.helpers.mutations import mutated

RANDOM, MUTATED = 6000, 6000
DECODERS = {protocol: StateDecoder(protocol) for protocol in (5, 10)}


def state_or_error(protocol, data):
    """1 for a state that makes sense, 0 for a WireError; anything else raises."""
    try:
        state = DECODERS[protocol].decode(memoryview(data))
    except WireError as error:
        assert len(str(error)) > 20
        return 0
    assert len(data) == fci_peer.STATE_SIZE[protocol]
    for values in (state.q, state.dq, state.tau_J, state.tau_J_d):
        assert values.shape == (7,)
        assert values.dtype == np.float64
    assert 0 <= state.message_id <= 1 << 40
    status = state.status
    assert status.generator < tables.GENERATOR_MODES[protocol]
    assert status.controller < 4
    assert status.robot_mode < 8
    assert set(status.errors + status.reflex_reason) <= {0, 1}
    assert len(status.errors) == len(status.reflex_reason) == 41
    return 1


def replies_or_error(stream, cuts):
    """Feed a stream in pieces and read each reply in every way; 0 for a WireError."""
    parser = codec.ReplyParser()
    try:
        for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
            for reply in parser.feed(stream[begin:end]):
                for version in (5, 10):
                    codec.connect_reply(reply.payload)
                    status = codec.status_reply(reply.payload)
                    for statuses in (tables.MOVE_STATUS, tables.STOP_STATUS, tables.RECOVER_STATUS):
                        name = tables.status_name(statuses[version], status)
                        assert len(tables.meaning(name)) > 10
    except WireError as error:
        assert len(str(error)) > 20
        return 0
    return 1


@pytest.mark.parametrize("protocol", [5, 10])
def test_states_random_and_mutated(protocol):
    rng = np.random.default_rng(protocol)
    size = fci_peer.STATE_SIZE[protocol]
    good = fci_peer.state(protocol, 5, q=range(7), modes=(1, 2, 2), errors=(3,), rate=0.9)
    taken = 0
    for k in range(RANDOM):
        length = size if k % 2 else int(rng.integers(0, 2 * size))
        assert state_or_error(protocol, rng.bytes(length)) in (0, 1)
    for _ in range(MUTATED):
        taken += state_or_error(protocol, mutated(rng, good))
    assert 0.1 * MUTATED < taken < 0.9 * MUTATED  # both answers were tried
    assert state_or_error(protocol, good) == 1


def test_replies_random_and_mutated():
    rng = np.random.default_rng(1)
    good = b"".join(
        fci_peer.reply(command, k, payload)
        for k, (command, payload) in enumerate(
            ((0, struct.pack("<BH", 0, 5)), (1, b"\1\0\0"), (1, b"\6\0\0"), (12, b"\2\0\0"))
        )
    )
    assert replies_or_error(good, []) == 1
    taken = 0
    for k in range(RANDOM + MUTATED):
        stream = mutated(rng, good) if k % 2 else rng.bytes(int(rng.integers(0, 200)))
        cuts = sorted(rng.integers(0, len(stream) + 1, size=rng.integers(0, 5)).tolist())
        taken += replies_or_error(stream, cuts)
    assert 0.05 * (RANDOM + MUTATED) < taken < 0.95 * (RANDOM + MUTATED)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    payloads=st.lists(st.binary(max_size=60), max_size=8),
    cuts=st.lists(st.integers(0, 600), max_size=8),
)
def test_replies_come_through_unchanged(payloads, cuts):
    stream = b"".join(fci_peer.reply(1, k, payload) for k, payload in enumerate(payloads))
    places = sorted(min(cut, len(stream)) for cut in cuts)
    parser = codec.ReplyParser()
    got = [
        reply
        for begin, end in zip([0, *places], [*places, len(stream)], strict=True)
        for reply in parser.feed(stream[begin:end])
    ]
    assert got == [codec.Reply(k, payload) for k, payload in enumerate(payloads)]
