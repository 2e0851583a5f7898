"""Hashes and checksums of files, as a run and `diagnosis.json` hold them."""

import zlib
from collections.abc import Iterable, Iterator
from hashlib import sha256
from pathlib import Path


def hash_files(paths: Iterable[Path]) -> str:
    """SHA-256 of files, one after another, in hex.

    Raises:
        OSError: One of them cannot be read.
    """
    digest = sha256()
    for path in paths:
        for piece in _pieces(path):
            digest.update(piece)
    return digest.hexdigest()


def compute_crc32(path: Path) -> int:
    """CRC-32 of a file.

    Raises:
        OSError: It cannot be read.
    """
    crc32 = 0
    for piece in _pieces(path):
        crc32 = zlib.crc32(piece, crc32)
    return crc32


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(1 << 20):
            yield piece
