"""What runs there are, here or on object storage, and of which bench, damper and day each is."""

import datetime
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from fsspec.core import url_to_fs

from rig.inputs.errors import InputError
from rig.io.run_log import RUN_FILE

FIELDS = ("bench", "damper", "date")
"""What a pattern may name."""

UNKNOWN = "unknown"
"""A bench or a damper that nobody named."""

_DAY = re.compile(r"(?<!\d)(\d{4})-?(\d{2})-?(\d{2})(?!\d)")
_FORBIDDEN = re.compile(r"[/\\\x00-\x1f]")


@dataclass(frozen=True)
class Source:
    """A run that may be evaluated.

    Attributes:
        url: Where it is: a run's folder or a CSV file.
        is_folder: Whether it is a folder.
        bench: Bench that it ran on.
        damper: Damper that was on it.
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


def find_sources(given: Sequence[str], pattern: str | None = None) -> list[Source]:
    """All runs in or at some places, by bench, day and place.

    Args:
        given: Run folders, CSV files, or folders with any number of either; any of them as a URL
            that fsspec knows (``s3://...``).
        pattern: Path of a run from its place on, with ``{bench}``, ``{damper}`` and ``{date}``, and
            ``*`` for what does not matter. Without it the folder above a run is the bench, and a
            day is looked for in the path.

    Raises:
        InputError: A place is not there, or holds no run; the pattern is wrong, or does not fit.
    """
    compiled = None if pattern is None else _compiled(pattern)
    found: dict[str, Source] = {}
    for place in given:
        there = list(_in_place(place, compiled, pattern))
        if not there:
            raise InputError(f"{place}: no runs, expected run folders or CSV files")
        found |= {source.url: source for source in there}
    return sorted(
        found.values(), key=lambda item: (item.bench, item.date or item.changed, item.url)
    )


def shard_of(sources: Sequence[Source], index: int, count: int) -> list[Source]:
    """One of so many parts; a run is in the same part whatever else there is.

    Args:
        sources: All runs.
        index: Which part, from 1 on.
        count: How many parts.
    """
    return [item for item in sources if zlib.crc32(item.url.encode()) % count == index - 1]


def _in_place(
    place: str, compiled: re.Pattern[str] | None, pattern: str | None
) -> Iterator[Source]:
    files, protocol, root = _listed(place)
    folders = {str(PurePosixPath(p).parent) for p in files if PurePosixPath(p).name == RUN_FILE}
    sizes: dict[str, int] = {}
    stamps: dict[str, str] = {}
    for path, info in files.items():
        run = next((str(up) for up in PurePosixPath(path).parents if str(up) in folders), None)
        if run is None and not path.endswith(".csv"):
            continue
        run = run or path
        sizes[run] = sizes.get(run, 0) + int(info.get("size") or 0)
        stamps[run] = max(stamps.get(run, ""), _stamp(info))
    for run, size in sizes.items():
        inside = (
            str(PurePosixPath(run).relative_to(root)) if run != root else PurePosixPath(run).name
        )
        fields = _fields(inside, run, compiled, pattern)
        day = _day(fields.get("date", "") or ("" if compiled else inside))
        yield Source(
            f"{protocol}{run}",
            run in folders,
            fields.get("bench") or UNKNOWN,
            fields.get("damper") or UNKNOWN,
            day,
            stamps[run][:10],
            size,
            stamps[run],
        )


def _listed(place: str) -> tuple[Mapping[str, Any], str, str]:
    """Files at a place with what is known of them, what URLs of it begin with, and its root."""
    try:
        system, root = url_to_fs(place)
        files = system.find(root, detail=True)
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"{place}: cannot be read ({error})") from error
    protocol = "" if "://" not in place else place.split("://", 1)[0] + "://"
    return files, protocol, root.rstrip("/")


def _stamp(info: Mapping[str, Any]) -> str:
    """Time of the last change as text that sorts by time."""
    changed = info.get("mtime") or info.get("LastModified") or info.get("created") or 0
    if isinstance(changed, int | float):
        changed = datetime.datetime.fromtimestamp(float(changed), datetime.UTC)
    if isinstance(changed, datetime.datetime):
        return changed.astimezone(datetime.UTC).isoformat()
    return str(changed)


def _compiled(pattern: str) -> re.Pattern[str]:
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
        raise InputError(f"{inside}: does not fit --path {pattern!r}")
    return found.groupdict()


def _day(text: str) -> str:
    """The last day that a text names; empty if it names none."""
    for year, month, day in reversed(_DAY.findall(text)):
        try:
            return datetime.date(int(year), int(month), int(day)).isoformat()
        except ValueError:
            continue
    return ""
