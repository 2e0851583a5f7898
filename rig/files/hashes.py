"""Hashes of files, as `run.yaml` and `diagnosis.json` hold them."""

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path


def hash_files(paths: Iterable[Path]) -> str:
    """SHA-256 of files, one after another, in hex.

    Raises:
        OSError: One of them cannot be read.
    """
    digest = sha256()
    for path in paths:
        with path.open("rb") as file:
            while piece := file.read(1 << 20):
                digest.update(piece)
    return digest.hexdigest()
