"""Arrays that are used again: fresh memory costs more than what is written to it.

The first touch of each 4 KiB of fresh memory is a visit to the operating system. Kept arrays have none, and large ones
lie on large pages (numpy asks for them), so that streaming over them misses fewer address translations.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

# Numpy asks for large pages from 4 MiB on: smaller arrays get so many bytes, most of which are never touched.
SMALLEST = 1 << 22


# Bytes of a line of the cache.
LINE = 64


def on_lines(shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """Array of undefined content that begins with a line of the cache: rows of 32 or 64 bytes lie within one line each.

    Numpy's own begin 16 bytes later, so that every other row of 32 bytes, and every row of 64, lies across two.
    """
    entry = np.dtype(dtype)
    size = prod(shape) * entry.itemsize
    memory = np.empty(size + LINE, np.uint8)
    begin = -memory.ctypes.data % LINE
    return memory[begin : begin + size].view(entry).reshape(shape)


class Buffers:
    """Memory of one owner that calls the same functions again and again, one call at a time."""

    def __init__(self) -> None:
        self._kept: dict[str, npt.NDArray[Any]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Array of undefined content; it is valid until an array of the same name is asked for.

        Args:
            name: of the use, which has one dtype.
            shape: as wanted now; the memory grows by a quarter more than that where it is too small.
            dtype: of the entries.
        """
        size = prod(shape)
        kept = self._kept.get(name)
        if kept is None or kept.size < size:
            entry = np.dtype(dtype)
            kept = on_lines((max(size + size // 4, SMALLEST // entry.itemsize),), entry)
            self._kept[name] = kept
        return kept[:size].reshape(shape)
