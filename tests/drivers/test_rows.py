"""Rows that wait in a file come back bit by bit, on either side of what stays in memory."""

import numpy as np
import pytest

from drivers.files import rows
from drivers.files.rows import RowsFile


@pytest.mark.parametrize("in_memory", [64, 2**20])
def test_rows_come_back_bit_by_bit(monkeypatch, in_memory: int) -> None:
    monkeypatch.setattr(rows, "IN_MEMORY", in_memory)
    rng = np.random.default_rng(3)
    table = rng.standard_normal((500, 5))
    table[7, 2], table[8, 3], table[9, 0] = np.nan, -0.0, np.int64(2**62 + 1).view(np.float64)
    kept = RowsFile(5)
    for start in range(0, 500, 33):
        kept.append(table[start : start + 33, :])
        assert kept.rows(start, start + 5).tobytes() == table[start : start + 5].tobytes()
    assert len(kept) == 500
    for start, stop in ((0, 500), (5, 10), (490, 600), (700, 800), (9, 3)):
        found = kept.rows(start, stop)
        assert found.tobytes() == table[start:stop].tobytes()
        assert found.shape == table[start:stop].shape
        assert found.flags.writeable


def test_rows_of_another_width_are_refused() -> None:
    with pytest.raises(ValueError, match="rows of 5 numbers"):
        RowsFile(5).append(np.zeros((2, 4)))
