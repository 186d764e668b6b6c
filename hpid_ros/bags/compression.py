"""What bags are compressed with: zstd for files, messages and chunks, lz4 for chunks."""

from __future__ import annotations

import sys
import zlib
from typing import Any

import lz4.frame  # type: ignore[import-untyped]

from hpid_ros.errors import BagError

zstd: Any  # of the standard library from CPython 3.14 on, else its backport
if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd


def decompressed(compression: str, raw: bytes, size: int, crc: int) -> bytes:
    """Return a chunk's records.

    Args:
        compression: ``"zstd"``, ``"lz4"`` or empty.
        raw: The records as stored.
        size: Their length when decompressed.
        crc: Their checksum, or 0.

    Raises:
        BagError: They cannot be decompressed, or have another length or checksum.
    """
    try:
        if compression == "zstd":
            records = bytes(zstd.decompress(raw))
        elif compression == "lz4":
            records = bytes(lz4.frame.decompress(raw))
        elif not compression:
            records = raw
        else:
            raise BagError(f"unknown compression {compression!r}")
    except BagError:
        raise
    # Both libraries raise whatever their C code finds: RuntimeError, ZstdError, EOFError.
    except Exception as error:
        raise BagError(f"{compression} data is damaged") from error
    if len(records) != size:
        raise BagError(f"{len(records)} bytes instead of {size}")
    check_sum(records, crc)
    return records


def decompressed_part(compression: str, raw: bytes) -> bytes:
    """Return what can be decompressed of a chunk that is cut off."""
    try:
        if compression == "zstd":
            return bytes(zstd.ZstdDecompressor().decompress(raw))
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(raw))
    except Exception as error:  # as above
        raise BagError(f"{compression} data is damaged") from error
    return raw


def check_sum(records: Any, crc: int) -> None:
    """Raise BagError unless the checksum is right or not given."""
    if crc and zlib.crc32(records) != crc:
        raise BagError("wrong checksum")
