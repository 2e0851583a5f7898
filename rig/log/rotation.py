"""When a run is continued in further files, and the two files of a part."""

from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from rig.log.checksums import checksum_line
from rig.log.file_names import FRAMES_FILE, STEPS_FILE, part_name
from rig.log.step_columns import END_OF_STREAM
from rig.log.whole_file import WholeFile


@dataclass(frozen=True)
class Rotation:
    """Size of frames and steps, and time, from which on other files follow; None for never."""

    size_bytes: int | None = None
    time_ns: int | None = None


class Part:
    """Frames and steps of one part of a run, being written.

    Raises:
        OSError: A file cannot be created.
    """

    def __init__(self, folder: Path, number: int, schema: pa.Schema, begin_ns: int) -> None:
        self.number = number
        self.begin_ns = begin_ns
        self.frames = WholeFile(folder / part_name(FRAMES_FILE, number))
        try:
            self.steps = WholeFile(folder / part_name(STEPS_FILE, number))
            try:
                self.steps.append(schema.serialize().to_pybytes())
            except OSError:
                self.steps.close()
                raise
        except OSError:
            self.frames.close()
            raise

    @property
    def size(self) -> int:
        """Bytes of both files."""
        return self.frames.size + self.steps.size

    @property
    def checksums(self) -> str:
        """Lines of `CHECKSUMS_FILE` for both files, once they are closed."""
        return "".join(
            checksum_line(file.name, file.size, file.crc32) for file in (self.frames, self.steps)
        )

    def end(self) -> None:
        """End the Arrow stream."""
        self.steps.append(END_OF_STREAM)

    def sync(self) -> None:
        """Have both files on the disk, as far as they are written."""
        self.frames.sync()
        self.steps.sync()

    def close(self) -> None:
        """Close both files."""
        self.steps.close()
        self.frames.close()
