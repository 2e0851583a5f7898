"""A file that grows by whole pieces, whatever the disk does."""

import contextlib
import os
import zlib
from pathlib import Path


class WholeFile:
    """A file to which pieces are appended, unbuffered. One that fails leaves no part of itself.

    Raises:
        OSError: It cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._file = path.open("wb", buffering=0)
        self.size = 0
        """Bytes of the pieces that are in it."""
        self.crc32 = 0
        """CRC-32 of them."""

    def append(self, piece: bytes) -> None:
        """Append a piece.

        Raises:
            OSError: It could not be written; the file is as it was, and may be tried again.
        """
        if not piece:
            return
        written = 0
        try:
            # A disk that is nearly full takes a part and says so only with the next one.
            while written < len(piece):
                written += self._file.write(piece[written:] if written else piece)
        except OSError:
            self._file.seek(self.size)
            with contextlib.suppress(OSError):
                self._file.truncate()
            raise
        self.size += len(piece)
        self.crc32 = zlib.crc32(piece, self.crc32)

    def sync(self) -> None:
        """Have what was appended on the disk.

        Raises:
            OSError: The disk failed; what was appended since the last time may be lost.
        """
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Close the file.

        Raises:
            OSError: The disk failed late.
        """
        self._file.close()
