"""How long a classic NetCDF file of 64-bit sizes (CDF-5) must be, from its header.

Source: https://docs.unidata.ucar.edu/netcdf-c/current/file_format_specifications.html
"""

from __future__ import annotations

import struct
from math import prod
from pathlib import Path
from typing import BinaryIO

# Bytes of a number by its type: byte, char, short, int, float, double, ubyte to uint64.
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8, 7: 1, 8: 2, 9: 4, 10: 8, 11: 8}

STREAMING = 2**64 - 1  # a number of records that its writer did not know


def end_of_cdf5(path: Path) -> int:
    """The byte after the last sample; raises ValueError for a header that is cut or none."""
    with path.open("rb") as file:
        try:
            return _end(_Header(file))
        except (struct.error, KeyError, IndexError, OverflowError) as error:
            raise ValueError("its header is cut or damaged") from error


class _Header:
    """Reads numbers, names and lists one after the other."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        file.seek(4)

    def small(self) -> int:
        return int(struct.unpack(">I", self._file.read(4))[0])

    def number(self) -> int:
        return int(struct.unpack(">Q", self._file.read(8))[0])

    def count(self) -> int:
        """Of a list: a tag, then how many."""
        self.small()
        return self.number()

    def skip(self, n_bytes: int) -> None:
        """Over some bytes, and what fills them up to four."""
        self._file.seek(_padded(n_bytes), 1)

    def attributes(self) -> None:
        for _ in range(self.count()):
            self.skip(self.number())
            kind = self.small()
            self.skip(SIZES[kind] * self.number())


def _end(header: _Header) -> int:
    n_records = header.number()
    lengths = []
    for _ in range(header.count()):
        header.skip(header.number())
        lengths.append(header.number())
    header.attributes()
    fixed: list[tuple[int, int]] = []
    by_record: list[tuple[int, int]] = []
    for _ in range(header.count()):
        header.skip(header.number())
        shape = [lengths[header.number()] for _ in range(header.number())]
        header.attributes()
        size = SIZES[header.small()]
        header.number()  # its bytes, which may be too many for this number
        begin = header.number()
        in_records = bool(shape) and shape[0] == 0
        (by_record if in_records else fixed).append((begin, size * prod(shape[in_records:])))
    ends = [begin + n_bytes for begin, n_bytes in fixed]
    if n_records not in (0, STREAMING):
        alone = len(by_record) == 1
        step = sum(n if alone else _padded(n) for _, n in by_record)
        ends += [begin + (n_records - 1) * step + n for begin, n in by_record]
    return max(ends, default=0)


def _padded(n_bytes: int) -> int:
    return -(-n_bytes // 4) * 4
