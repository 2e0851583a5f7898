"""What is changed while a run goes on: gains and limits, from one tick on.

A change is checked as the configuration is. It becomes another bridge, made ready beside the loop,
which goes on from the state of the one before; the log says from which tick on, so that a replay
changes there too.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text, validate
from rig.bridge.bridge import Bridge
from rig.log.file_names import CHANGES_FILE
from rig.plan.config import RunConfig
from rig.plan.setup import Setup

CHANGEABLE = ("observers", "supervision")
"""Sections of the configuration that can be changed while a run goes on."""

Assignments = Mapping[str, object]
"""Values by their keys in the configuration, sections joined by dots."""

Changes = Callable[[int], Bridge | None]
"""Time of a tick -> the bridge from that tick on, if it is another one."""


def unchanged(_t_ns: int) -> None:
    """Nothing is changed."""


def parse_assignments(texts: Sequence[str]) -> dict[str, object]:
    """Assignments from texts such as ``observers.strut.proportional_n_per_m=2e5``.

    Raises:
        InputError: A text is none.
    """
    found: dict[str, object] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (key and equals and value):
            raise InputError(
                f"{text!r}: expected KEY=VALUE, as in observers.strut.force_limit_n=900"
            )
        found[key.strip()] = parse_mapping(f"value: {value}", repr(text))["value"]
    return found


def reassigned(ready: Setup, assignments: Assignments, source: str) -> Setup:
    """A configuration with other values.

    Args:
        ready: The configuration.
        assignments: What is changed.
        source: What to call the change in an error.

    Raises:
        InputError: A key cannot be changed or is unknown, or a value is wrong.
    """
    content = ready.config.model_dump(mode="json")
    for key, value in assignments.items():
        section, *names = key.split(".")
        if section not in CHANGEABLE or not names:
            raise InputError(
                f"{source}: {key}: cannot be changed in a run, expected a key under "
                f"{' or '.join(CHANGEABLE)}"
            )
        _assign(content[section], names, value, source, key)
    config = validate(RunConfig, content, source)
    for name, observer in config.observers.items():
        before = ready.config.observers[name]
        if getattr(observer, "filter", None) != getattr(before, "filter", None):
            raise InputError(
                f"{source}: observers.{name}.filter: cannot be changed in a run, whose state is "
                "that of the filter it has"
            )
        if type(observer) is not type(before):
            raise InputError(
                f"{source}: observers.{name}.kind: cannot be changed in a run, whose state is "
                "that of the observer it has"
            )
    return ready.model_copy(update={"config": config})


def _assign(place: object, names: Sequence[str], value: object, source: str, key: str) -> None:
    """Set a value in a section; a row of a list goes by its number, from 0 on."""
    name, *others = names
    known: list[str] = []
    if isinstance(place, dict):
        known = list(cast("dict[str, object]", place))
    elif isinstance(place, list):
        known = [str(number) for number in range(len(cast("list[object]", place)))]
    if name not in known:
        expected = f"one of {', '.join(known)}" if known else "the key before it as a whole"
        raise InputError(f"{source}: {key}: no {name!r}, expected {expected}")
    holder = cast("dict[str | int, object]", place)
    index = int(name) if isinstance(place, list) else name
    if others:
        _assign(holder[index], others, value, source, key)
    elif isinstance(holder[index], dict):
        keys = ", ".join(f"{key}.{item}" for item in cast("dict[str, Any]", holder[index]))
        raise InputError(f"{source}: {key}: expected one of {keys}")
    else:
        holder[index] = value


def changed_bridge(bridge: Bridge, ready: Setup) -> Bridge:
    """The bridge with a configuration's observers and limits; model and messages are its own."""
    supervision = ready.config.supervision.supervision()
    core = bridge.core.changed(tuple(ready.config.observers.values()), supervision)
    return bridge.changed(core, supervision.limits)


def change_line(t_ns: int, assignments: Assignments) -> str:
    """A line of `CHANGES_FILE`: a change, with the time of the first tick that had it."""
    return json.dumps({"t_ns": t_ns, "set": assignments}) + "\n"


def logged_changes(folder: Path) -> list[tuple[int, dict[str, object]]]:
    """Changes of a run, in their order: time of the first tick, and what was changed.

    Raises:
        InputError: A line other than the last, which a kill may have cut, is none.
    """
    path = folder / CHANGES_FILE
    if not path.exists():
        return []
    found: list[tuple[int, dict[str, object]]] = []
    for number, line in enumerate(read_text(path).splitlines(keepends=True), start=1):
        try:
            entry = cast("dict[str, Any]", json.loads(line))
            found.append((int(entry["t_ns"]), dict(entry["set"])))
        except (ValueError, TypeError, KeyError) as error:
            if not line.endswith("\n"):
                break
            raise InputError(
                f"{path}: line {number}: {line.strip()[:60]!r}: expected a change such as "
                '{"t_ns": 0, "set": {}}'
            ) from error
    return found


def replayed_changes(folder: Path, ready: Setup, bridge: Bridge) -> Changes:
    """The changes of a run, for its replay.

    Raises:
        InputError: A change cannot be read or made.
    """
    coming: list[tuple[int, Bridge]] = []
    for t_ns, assignments in logged_changes(folder):
        ready = reassigned(ready, assignments, str(folder / CHANGES_FILE))
        bridge = changed_bridge(bridge, ready)
        coming.append((t_ns, bridge))
    if not coming:
        return unchanged
    coming.reverse()

    def changes(t_ns: int) -> Bridge | None:
        now = None
        while coming and coming[-1][0] <= t_ns:
            now = coming.pop()[1]
        return now

    return changes
