"""Changes of gains and limits while a run is going on, from one tick on.

A change is checked as the configuration is. It becomes another bridge, prepared outside the loop,
which continues from the state of the one before; the log holds the tick from which on, so that a
replay changes there too. During a run `rig.run.change_requests` hands the bridge to the loop
(`rig.run.loop.run`), which asks for it at every tick.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text, validate
from rig.bridge.bridge import Bridge
from rig.log.file_names import CHANGES_FILE
from rig.plan.config import RunConfig
from rig.plan.plan import Plan

CHANGEABLE = ("observers", "supervision")
"""Sections of the configuration that can be changed during a run."""

Assignments = Mapping[str, object]
"""Values by their keys in the configuration, sections joined by dots."""

Changes = Callable[[int], Bridge | None]
"""Time of a tick -> the bridge from that tick on, if it is another one."""


def no_changes(_t_ns: int) -> None:
    """Changes of a run that is never changed."""


def parse_assignments(texts: Sequence[str]) -> dict[str, object]:
    """Assignments from texts such as ``observers.strut.proportional_n_per_m=2e5``.

    Raises:
        InputError: A text is not an assignment.
    """
    assignments: dict[str, object] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (key and equals and value):
            raise InputError(
                f"{text!r}: expected KEY=VALUE, as in observers.strut.force_limit_n=900"
            )
        assignments[key.strip()] = parse_mapping(f"value: {value}", repr(text))["value"]
    return assignments


def assign(plan: Plan, assignments: Assignments, source: str) -> Plan:
    """The plan with other values; an error calls the change `source`.

    Raises:
        InputError: A key cannot be changed or is unknown, or a value is wrong.
    """
    content = plan.config.model_dump(mode="json")
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
        before = plan.config.observers[name]
        if not observer.can_continue(before):
            key = "kind" if observer.kind != before.kind else "filter"
            raise InputError(
                f"{source}: observers.{name}.{key}: cannot be changed in a run, which continues "
                "from the state of its observer"
            )
    return plan.with_config(config)


def _assign(section: object, names: Sequence[str], value: object, source: str, key: str) -> None:
    """Set a value in a section; a row of a list goes by its number, from 0 on."""
    name, *others = names
    known: list[str] = []
    if isinstance(section, dict):
        known = list(cast("dict[str, object]", section))
    elif isinstance(section, list):
        known = [str(number) for number in range(len(cast("list[object]", section)))]
    if name not in known:
        expected = f"one of {', '.join(known)}" if known else "the key before it as a whole"
        raise InputError(f"{source}: {key}: no {name!r}, expected {expected}")
    holder = cast("dict[str | int, object]", section)
    index = int(name) if isinstance(section, list) else name
    if others:
        _assign(holder[index], others, value, source, key)
    elif isinstance(holder[index], dict):
        keys = ", ".join(f"{key}.{item}" for item in cast("dict[str, object]", holder[index]))
        raise InputError(f"{source}: {key}: expected one of {keys}")
    else:
        holder[index] = value


def bridge_with_settings(bridge: Bridge, plan: Plan) -> Bridge:
    """The bridge with a plan's observers and limits; model and messages are its own."""
    return bridge.with_settings(plan.observers, plan.config.supervision, plan.limits)


def change_line(t_ns: int, assignments: Assignments) -> str:
    """A line of `CHANGES_FILE`: a change, with the time of the first tick that had it."""
    return json.dumps({"t_ns": t_ns, "set": assignments}) + "\n"


def read_changes(folder: Path) -> list[tuple[int, dict[str, object]]]:
    """Changes of a run, in their order: time of the first tick, and what was changed.

    Raises:
        InputError: A line is not a valid change; the last may be cut off, as by a kill.
    """
    path = folder / CHANGES_FILE
    if not path.exists():
        return []
    changes: list[tuple[int, dict[str, object]]] = []
    for number, line in enumerate(read_text(path).splitlines(keepends=True), start=1):
        try:
            entry = json.loads(line)
            changes.append((int(entry["t_ns"]), dict(entry["set"])))
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            if not line.endswith("\n"):
                break
            raise InputError(
                f"{path}: line {number}: {line.strip()[:60]!r}: expected a change such as "
                '{"t_ns": 0, "set": {}}'
            ) from error
    return changes


def changes_for_replay(folder: Path, plan: Plan, bridge: Bridge) -> Changes:
    """The changes of a run, for its replay.

    Raises:
        InputError: A change cannot be read or made.
    """
    coming: list[tuple[int, Bridge]] = []
    for t_ns, assignments in read_changes(folder):
        plan = assign(plan, assignments, str(folder / CHANGES_FILE))
        bridge = bridge_with_settings(bridge, plan)
        coming.append((t_ns, bridge))
    if not coming:
        return no_changes
    coming.reverse()

    def changes(t_ns: int) -> Bridge | None:
        now = None
        while coming and coming[-1][0] <= t_ns:
            now = coming.pop()[1]
        return now

    return changes
