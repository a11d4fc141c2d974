"""Bytes that are nearly right."""


def mutated(rng, frame):
    """A copy with a few bytes changed, or bits flipped, or a piece cut, doubled or added."""
    data = bytearray(frame)
    kind = rng.integers(4)
    if kind == 0:
        for at in rng.integers(len(data), size=rng.integers(1, 9)):
            data[at] = rng.integers(256)
    elif kind == 1:
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        begin, end = sorted(rng.integers(len(data) + 1, size=2))
        data[begin:end] = b""
    else:
        begin, end = sorted(rng.integers(len(data) + 1, size=2))
        data[begin:begin] = data[begin:end]
    return bytes(data)
