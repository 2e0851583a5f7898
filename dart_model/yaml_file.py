"""YAML from outside, read as data: bounded, without aliases or repeated keys, then validated."""

from collections.abc import Hashable
from pathlib import Path
from typing import TypeVar, cast

import yaml
from pydantic import BaseModel, ValidationError

_MAX_BYTES = 4 * 1024 * 1024
_Model = TypeVar("_Model", bound=BaseModel)


class InputError(ValueError):
    """An input from outside is wrong; the message is one line that names it."""


class _PlainLoader(yaml.SafeLoader):
    """`SafeLoader` that refuses what a configuration never needs and a mistake or an attack has."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="aliases are not accepted", problem_mark=self.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, object]:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key!r} stands here twice", problem_mark=key_node.start_mark
                )
            if isinstance(key, Hashable):
                seen.add(key)
        return super().construct_mapping(node, deep)


def read_text(path: Path, max_bytes: int = _MAX_BYTES) -> str:
    """Text of a file.

    Args:
        path: The file.
        max_bytes: Largest size that is read.

    Raises:
        InputError: The file is missing, unreadable, too large or not UTF-8.
    """
    try:
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > max_bytes:
        raise InputError(f"{path}: larger than {max_bytes} bytes, expected a smaller file")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8, expected text") from error


def parse_mapping(text: str, source: str) -> dict[str, object]:
    """The mapping a YAML text holds.

    Args:
        text: YAML.
        source: What to call the text in an error, usually its path.

    Raises:
        InputError: The text is no YAML, or no mapping.
    """
    loader = _PlainLoader(text)
    try:
        data = cast("object", loader.get_single_data())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f" line {mark.line + 1}" if mark else ""
        raise InputError(f"{source}:{where} is no valid YAML: {error.problem}") from error
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{source}: is no valid YAML: {reason}") from error
    finally:
        loader.dispose()
    if not isinstance(data, dict):
        found = "nothing" if data is None else type(data).__name__
        raise InputError(f"{source}: expected keys and values at the top level, found {found}")
    mapping = cast("dict[object, object]", data)
    for key in mapping:
        if not isinstance(key, str):
            raise InputError(f"{source}: key {key!r}: expected a name")
    return cast("dict[str, object]", mapping)


def validated(model: type[_Model], data: object, source: str) -> _Model:
    """`data` as a frozen `model`.

    Raises:
        InputError: With the first error's key, value and expectation, and how many more there are.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise InputError(_one_line(error, source)) from error


def load_validated(model: type[_Model], path: Path) -> _Model:
    """The file at `path` as a frozen `model`.

    Raises:
        InputError: One line that names file, key, value and what was expected.
    """
    return validated(model, parse_mapping(read_text(path), str(path)), str(path))


def _one_line(error: ValidationError, source: str) -> str:
    errors = error.errors(include_url=False)
    # A misspelt key is worth more than the key that it leaves missing.
    first = min(errors, key=lambda item: item["type"] == "missing")
    # Parts in angle brackets are not keys: they tell apart what may stand under one.
    parts = [str(part) for part in first["loc"] if not str(part).startswith("<")]
    key = ".".join(parts) or "top level"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    cause = cast("dict[str, object]", first.get("ctx", {})).get("error")
    if cause is not None:
        return f"{source}: {key}: {cause}{more}"
    kind = first["type"]
    if kind == "missing":
        return f"{source}: {key}: is missing, expected a value{more}"
    if kind == "extra_forbidden":
        return f"{source}: {key}: unknown key, expected one of the documented ones{more}"
    value = repr(cast("object", first["input"]))
    shown = value if len(value) <= 60 else value[:57] + "..."
    return f"{source}: {key}: {shown}: {first['msg'][0].lower()}{first['msg'][1:]}{more}"
