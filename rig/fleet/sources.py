"""What runs there are, here or on object storage, and of which bench, damper and day each is."""

import contextlib
import datetime
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from fsspec.core import url_to_fs

from can_dbc.errors import InputError
from rig.log.file_names import RUN_FILE

FIELDS = ("bench", "damper", "date")
"""What a pattern may name."""

UNKNOWN = "unknown"
"""A bench or a damper without a name."""

_CHANGED = ("mtime", "LastModified", "last_modified", "updated", "created")
"""What file systems call the time of the last change."""

_LONGEST_NAME = 60
"""Of a bench or a damper: its folder in the store has a name, too."""

_DAY = re.compile(r"(?<!\d)(\d{4})-?(\d{2})-?(\d{2})(?!\d)")
_FORBIDDEN = re.compile(r"[/\\\x00-\x1f]")


@dataclass(frozen=True)
class RunSource:
    """A run that may be evaluated.

    Attributes:
        url: Where it is: a run's folder or a CSV file.
        date: Day as ``YYYY-MM-DD``; empty where only the run itself may know it.
        changed: Day on which it was last changed.
        size: Bytes of all its files.
        stamp: When it was last changed, as its file system says it.
    """

    url: str
    is_folder: bool
    bench: str
    damper: str
    date: str
    changed: str
    size: int
    stamp: str


def find_sources(given: Sequence[str], pattern: str | None = None) -> list[RunSource]:
    """All runs in or at some locations, by bench, day and location.

    Args:
        given: Run folders, CSV files, or folders with any number of either; any of them as a URL
            that fsspec knows (``s3://...``).
        pattern: Path of a run from its location on, with ``{bench}``, ``{damper}`` and ``{date}``,
            and ``*`` for what does not matter. Without it the folder above a run is the bench, and
            a day is looked for in the path.

    Raises:
        InputError: A location is not there, or holds no run; the pattern is wrong, or does not fit.
    """
    compiled = None if pattern is None else _compile_pattern(pattern)
    found: dict[str, RunSource] = {}
    for location in given:
        there = list(_find_in(location, compiled, pattern))
        if not there:
            raise InputError(f"{location}: no runs there, expected run folders or CSV files")
        found |= {source.url: source for source in there}
    return sorted(
        found.values(), key=lambda item: (item.bench, item.date or item.changed, item.url)
    )


def parse_shard(text: str) -> tuple[int, int]:
    """Number of a part, from 1 on, and how many there are, from a text such as `3/16`.

    Raises:
        InputError: It is none.
    """
    first, _, last = text.partition("/")
    is_number = text.isascii() and first.isdecimal() and last.isdecimal()
    if not (is_number and 1 <= int(first) <= int(last)):
        raise InputError(f"--shard {text!r}: expected I/N with I from 1 to N, such as 3/16")
    return int(first), int(last)


def select_shard(sources: Sequence[RunSource], index: int, count: int) -> list[RunSource]:
    """Share `index`, from 1 on, of `count`; a run is in the same one whatever the others are."""
    return [item for item in sources if zlib.crc32(os.fsencode(item.url)) % count == index - 1]


def _find_in(
    location: str, compiled: re.Pattern[str] | None, pattern: str | None
) -> Iterator[RunSource]:
    files, protocol, root = _list_files(location)
    folders = {str(PurePosixPath(p).parent) for p in files if PurePosixPath(p).name == RUN_FILE}
    runs: dict[str, list[Mapping[str, Any]]] = {}
    for path, info in files.items():
        run = next((str(up) for up in PurePosixPath(path).parents if str(up) in folders), None)
        if run is not None or path.lower().endswith(".csv"):
            runs.setdefault(run or path, []).append(info)
    for run, infos in runs.items():
        stamp = max(map(_stamp, infos))
        inside = (
            str(PurePosixPath(run).relative_to(root)) if run != root else PurePosixPath(run).name
        )
        fields = _fields(inside, run, compiled, pattern)
        day = _day(fields.get("date", "" if compiled else inside))
        if "date" in fields and not day:
            raise InputError(f"{inside}: {fields['date']!r}: expected a day such as 2026-01-05")
        _refuse_names(inside, fields)
        yield RunSource(
            f"{protocol}{run}",
            run in folders,
            printable(fields.get("bench") or UNKNOWN),
            printable(fields.get("damper") or UNKNOWN),
            day,
            stamp[:10],
            sum(int(info.get("size") or 0) for info in infos),
            stamp,
        )


def _list_files(location: str) -> tuple[Mapping[str, Any], str, str]:
    """Files at a location with what is known of them, what URLs of it begin with, and its root."""
    if "://" not in location:
        return _list_local_files(Path(location)), "", str(Path(location).absolute())
    try:
        system, root = url_to_fs(location)
        files = system.find(root, detail=True)
    except Exception as error:  # of any library that knows such locations
        raise InputError(f"{location}: cannot be read ({error})") from error
    return files, location.split("://", 1)[0] + "://", root.rstrip("/")


def _list_local_files(location: Path) -> dict[str, dict[str, float]]:
    """Files of this machine at a location, also behind links."""
    found: dict[str, dict[str, float]] = {}
    location = location.absolute()

    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})") from error

    listed = os.walk(location, followlinks=True, onerror=refuse) if location.is_dir() else []
    paths = [Path(folder) / name for folder, _, names in listed for name in names]
    for path in [*paths, *([location] if location.is_file() else [])]:
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            found[str(path)] = {"size": status.st_size, "mtime": status.st_mtime}
    return found


def _stamp(info: Mapping[str, Any]) -> str:
    """Time of the last change as text that sorts by time."""
    changed = next((info[name] for name in _CHANGED if info.get(name)), 0)
    if isinstance(changed, int | float):
        changed = datetime.datetime.fromtimestamp(float(changed), datetime.UTC)
    if isinstance(changed, datetime.datetime):
        return changed.astimezone(datetime.UTC).isoformat()
    return str(changed)


def _compile_pattern(pattern: str) -> re.Pattern[str]:
    parts = re.split(r"(\{[^{}]*\}|\*)", pattern.removesuffix(".csv"))
    seen: set[str] = set()
    text = ""
    for part in parts:
        if part == "*":
            text += "[^/]*"
        elif part.startswith("{"):
            name = part[1:-1]
            if name not in FIELDS or name in seen:
                expected = ", ".join(f"{{{field}}}" for field in FIELDS)
                raise InputError(f"--path {pattern!r}: {part}: expected {expected}, each once")
            seen.add(name)
            text += f"(?P<{name}>[^/]+?)"
        else:
            text += re.escape(part)
    return re.compile(text)


def _fields(
    inside: str, run: str, compiled: re.Pattern[str] | None, pattern: str | None
) -> dict[str, str]:
    if compiled is None:
        above = PurePosixPath(run).parent.name
        return {"bench": _FORBIDDEN.sub("_", above)}
    found = compiled.fullmatch(inside.removesuffix(".csv"))
    if found is None:
        raise InputError(
            f"{inside}: does not fit --path {pattern!r}, expected as many folders in the pattern "
            "as in the path of each run"
        )
    return found.groupdict()


def _refuse_names(inside: str, fields: Mapping[str, str]) -> None:
    for key in ("bench", "damper"):
        name = fields.get(key, "")
        if len(name.encode("utf-8", "replace")) > _LONGEST_NAME or name.startswith("__HIVE"):
            raise InputError(
                f"{inside!a}: {key} {name[:80]!a}: expected a name of at most {_LONGEST_NAME} bytes"
            )


def printable(text: str) -> str:
    """A path as text that can be written, whatever its bytes are."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _day(text: str) -> str:
    """The last day that a text names; empty if it names none."""
    for year, month, day in reversed(_DAY.findall(text)):
        try:
            return datetime.date(int(year), int(month), int(day)).isoformat()
        except ValueError:
            continue
    return ""
