"""Chunks of an MCAP file, whole or cut: none, zstd, lz4."""

from __future__ import annotations

import importlib

import zstandard

_COMPRESSIONS = ("", "zstd", "lz4")
_CHUNK_LIMIT = 2**32  # bytes; a larger claim comes from a damaged chunk


class DamagedChunk(ValueError):
    """A chunk's bytes are not what its head says."""


def decompress(name: str, data: memoryview, size: int, cut: bool = False) -> memoryview:
    """The records of a chunk.

    Args:
        name: how it is compressed.
        data: the compressed bytes.
        size: how many bytes they make.
        cut: the end is missing; give what can be had.

    Raises:
        DamagedChunk: the bytes cannot be decompressed, or make another size.
    """
    if name not in _COMPRESSIONS:
        raise DamagedChunk(f"it is compressed by {name!r} (known: none, zstd, lz4)")
    if size > _CHUNK_LIMIT:
        raise DamagedChunk(f"it claims {size} bytes")
    try:
        content = _DECOMPRESSORS[name](data, size, cut)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamagedChunk(f"{name} cannot read it ({error})") from error
    if not cut and len(content) != size:
        raise DamagedChunk(f"it makes {len(content)} bytes instead of {size}")
    return content


def _stored(data: memoryview, size: int, cut: bool) -> memoryview:
    return data


def _zstd(data: memoryview, size: int, cut: bool) -> memoryview:
    if cut:
        return memoryview(zstandard.ZstdDecompressor().decompressobj().decompress(data))
    return memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))


def _lz4(data: memoryview, size: int, cut: bool) -> memoryview:
    frame = importlib.import_module("lz4.frame")  # comes with mcap; imported only where needed
    return memoryview(frame.LZ4FrameDecompressor().decompress(data))


_DECOMPRESSORS = {"": _stored, "zstd": _zstd, "lz4": _lz4}
