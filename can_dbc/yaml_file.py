"""YAML from outside, read as data: bounded, without aliases or repeated keys, then validated."""

import re
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, TypeVar, cast

import yaml
from pydantic import BaseModel, BeforeValidator, Field, ValidationError
from pydantic_core import PydanticCustomError

from can_dbc.errors import FileError, expected_name

_MAX_BYTES = 4 * 1024 * 1024
"""Largest file; a model with a thousand struts has a tenth of it."""

_TEXT, _INT, _FLOAT = (f"tag:yaml.org,2002:{name}" for name in ("str", "int", "float"))
_INTEGER = re.compile(r"[-+]?(?:0[bx])?[0-9a-fA-F]{1,40}")
"""Integers up to twice as long as any of 64 bits; Python writes none of more than 4300 digits."""

_Model = TypeVar("_Model", bound=BaseModel)


def _no_truth_value(value: object) -> object:
    """Refuse `true`, which would otherwise be read as 1."""
    if isinstance(value, bool):
        raise PydanticCustomError("number", "expected a number")
    return value


Finite = Annotated[float, BeforeValidator(_no_truth_value), Field(allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0)]
NotNegative = Annotated[Finite, Field(ge=0)]
Seconds = Annotated[NotNegative, Field(le=1e9)]
"""A time that an integer of nanoseconds holds: thirty years are more than any run."""

PositiveSeconds = Annotated[Seconds, Field(gt=0)]


class _PlainLoader(yaml.SafeLoader):
    """`SafeLoader` that refuses what only a mistake or an attack contains."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        events = cast("Any", self)  # untyped in the stubs
        if events.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="aliases are not accepted", problem_mark=events.peek_event().start_mark
            )
        return super().compose_node(parent, index)

    def resolve(
        self, kind: type[yaml.Node], value: str | None, implicit: tuple[bool, bool] | bool
    ) -> str:
        tag = str(cast("Any", super()).resolve(kind, value, implicit))
        # To YAML 1.1, 1:30 is 90: base 60, in a time that grows with the square of its length.
        return _TEXT if tag in (_INT, _FLOAT) and ":" in (value or "") else tag

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        text = str(self.construct_scalar(node))
        if not _INTEGER.fullmatch(text.replace("_", "")):
            raise yaml.MarkedYAMLError(
                problem=f"{text[:40]!r}: expected an integer of at most 40 digits",
                problem_mark=node.start_mark,
            )
        return int(super().construct_yaml_int(node))

    def construct_yaml_float(self, node: yaml.ScalarNode) -> float:
        text = str(self.construct_scalar(node))
        if ":" in text:
            raise yaml.MarkedYAMLError(
                problem=f"{text[:40]!r}: expected a number without colons",
                problem_mark=node.start_mark,
            )
        return float(super().construct_yaml_float(node))

    def construct_mapping(
        self, node: yaml.MappingNode, deep: bool = False
    ) -> dict[Hashable, object]:
        seen: set[object] = set()
        for key_node, _ in node.value:
            key = cast("object", cast("Any", self).construct_object(key_node, deep=True))
            if isinstance(key, Hashable) and key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key!r} occurs twice: delete one of them",
                    problem_mark=key_node.start_mark,
                )
            if isinstance(key, Hashable):
                seen.add(key)
        return super().construct_mapping(node, deep)


_PlainLoader.add_constructor(_INT, _PlainLoader.construct_yaml_int)
_PlainLoader.add_constructor(_FLOAT, _PlainLoader.construct_yaml_float)
# YAML 1.1 reads 1e5, without a point, as text.
cast("Any", _PlainLoader).add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9]+([.][0-9]*)?[eE][-+]?[0-9]+$"),
    "-+0123456789",
)

_NO_YAML = (yaml.YAMLError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError)
"""What PyYAML raises for a text that is none, or for a tag whose value does not fit it."""


_CURES = {
    "mapping values are not allowed": "a second colon, or an indentation that is not that of the "
    "lines around it",
    "<block end>": "expected the indentation of the lines around it",
    "\\t": "a tab, expected blanks",
    "<stream end>": "a bracket is open to the end of the file",
}
"""Part of what PyYAML says -> what a person has to look for."""


_KINDS = ((type(None), "is empty"), (list, "is a list"), (str, "is a single text"))
"""What a file is that has no keys."""


def read_text(path: Path, max_bytes: int = _MAX_BYTES) -> str:
    """Text of a file of at most `max_bytes`.

    Raises:
        FileError: The file is missing, unreadable, too large or not UTF-8.
    """
    try:
        if path.is_fifo():  # reading one would wait for ever
            raise FileError(f"{path}: is a pipe, expected a file")
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except FileNotFoundError as error:
        raise FileError(f"{path}: no such file") from error
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > max_bytes:
        raise FileError(f"{path}: larger than {max_bytes} bytes, expected a smaller file")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: byte {error.start} is not UTF-8, expected text") from error


def parse_mapping(text: str, source: str) -> dict[str, object]:
    """The mapping that a YAML text contains; an error calls the text `source`.

    Raises:
        FileError: The text is no YAML, or no mapping.
    """
    try:
        data = cast("object", yaml.load(text, _PlainLoader))  # noqa: S506 - it is a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f" line {mark.line + 1}" if mark else ""
        problem = error.problem or ""
        cure = next((text for sign, text in _CURES.items() if sign in problem), problem)
        raise FileError(f"{source}:{where} is no valid YAML: {cure}") from error
    except (*_NO_YAML, RecursionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{source}: is no valid YAML: {reason}") from error
    if not isinstance(data, dict):
        kind = next((text for type_, text in _KINDS if isinstance(data, type_)), "is a number")
        raise FileError(f"{source}: {kind}, expected keys and values")
    mapping = cast("dict[object, object]", data)
    for key in mapping:
        if not isinstance(key, str):
            raise FileError(f"{source}: key {key!r}: expected a name")
    return cast("dict[str, object]", mapping)


def validate(model: type[_Model], data: object, source: str, context: object = None) -> _Model:
    """`data` as a frozen `model`, whose own checks get `context`; an error calls it `source`.

    Raises:
        FileError: With the first error's key, value and expectation, and how many more there are.
    """
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        raise FileError(_one_line(error, model, source)) from error


def load_yaml(
    model: type[_Model],
    path: Path,
    context: object = None,
    kinds: Mapping[str, str] = MappingProxyType({}),
) -> _Model:
    """The file at `path` as a frozen `model`; `context` as of `validate`.

    `kinds` states by a key of other files what they are: a file with such a key is named as one.

    Raises:
        FileError: One line that names file, key, value and what was expected.
    """
    content = parse_mapping(read_text(path), str(path))
    for key, kind in kinds.items():
        if key in content and key not in model.model_fields:
            raise FileError(f"{path}: is {kind}")
    return validate(model, content, str(path), context)


_NO_MAPPING = ("dict_type", "model_type", "model_attributes_type", "dataclass_type")
"""pydantic's names for a value where keys and values are expected."""

_EXPECTED = {
    "bool_type": "expected true or false",
    "bool_parsing": "expected true or false",
    "finite_number": "expected a finite number",
    "float_type": "expected a number",
    "int_from_float": "expected an integer",
    "int_parsing": "expected an integer",
    "int_type": "expected an integer",
    "list_type": "expected a list",
    "string_too_short": "expected a text that is not empty",
    "string_type": "expected a text",
    "tuple_type": "expected a list",
}
"""pydantic's name of an error -> what was expected."""

_BOUNDS = {
    "greater_than": ("gt", "expected more than {}"),
    "greater_than_equal": ("ge", "expected {} or more"),
    "less_than": ("lt", "expected less than {}"),
    "less_than_equal": ("le", "expected {} or less"),
    "string_too_long": ("max_length", "expected at most {} characters"),
    "too_long": ("max_length", "expected at most {} items"),
    "too_short": ("min_length", "expected at least {} item(s)"),
}
"""pydantic's name of an error -> name of the bound, and what was expected of the value."""

_MOST_MORE = 3
"""Further wrong keys that a line names."""

_LONGEST_VALUE = 60


def _one_line(error: ValidationError, model: type[BaseModel], source: str) -> str:
    errors = error.errors(include_url=False)
    # A list whose items are wrong is also called too short: that adds nothing.
    deepest = max(len(item["loc"]) for item in errors)
    errors = [item for item in errors if item["type"] != "too_short" or len(item["loc"]) == deepest]
    first = max(errors, key=lambda item: (len(item["loc"]), item["type"] == "extra_forbidden"))
    parts = _key_parts(first["loc"])
    key = ".".join(str(part) for part in parts) or "top level"
    more = _more([item["loc"] for item in errors if item is not first])
    context = cast("dict[str, object]", first.get("ctx", {}))
    cause = context.get("error")
    if cause is not None:
        where = f"{source}: {key}" if parts else source
        return f"{where}: {cause}{more}"
    kind = first["type"]
    if kind == "missing":
        return f"{source}: {_missing(parts)}{more}"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _keys(model.model_json_schema(), parts[:-1])
        expected = f", {expected_name(str(parts[-1]), known)}" if known else ""
        return f"{source}: {key}: unknown key{expected}{more}"
    if kind == "union_tag_invalid":
        tag = str(context["tag"]).strip("'<>")
        key = ".".join((key, str(context["discriminator"]).strip("'()")))
        expected = expected_name(tag, _choices(context["expected_tags"]))
        return f"{source}: {key}: {tag!r}: {expected}{more}"
    return f"{source}: {key}: {_shown(first['input'])}{_expected(first, context)}{more}"


def _key_parts(location: Iterable[int | str]) -> list[int | str]:
    """Keys and indices of a place; parts in angle brackets only distinguish kinds of a value."""
    return [part for part in location if part != "" and not str(part).startswith("<")]


def _more(others: Sequence[Iterable[int | str]]) -> str:
    if not others:
        return ""
    keys = dict.fromkeys(".".join(map(str, _key_parts(item))) or "top level" for item in others)
    named = ", ".join(list(keys)[:_MOST_MORE]) + (", ..." if len(keys) > _MOST_MORE else "")
    errors = "error" if len(others) == 1 else "errors"
    return f" (and {len(others)} more {errors}: {named})"


def _missing(parts: Sequence[int | str]) -> str:
    if parts and isinstance(parts[-1], int):
        list_key = ".".join(map(str, parts[:-1]))
        return f"{list_key}: {parts[-1]} item(s), expected more"
    return f"{'.'.join(map(str, parts))}: is missing, expected a value"


def _choices(text: object) -> list[str]:
    """Choices as pydantic lists them in one text."""
    return re.findall(r"'<?([^'<>]+)>?'", str(text))


def _shown(value: object) -> str:
    if value is None:
        return "is empty, "
    text = repr(value)
    return (text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "...") + ": "


def _expected(first: Any, context: dict[str, object]) -> str:
    kind, value = first["type"], first["input"]
    if kind in _NO_MAPPING:
        return "expected keys and values"
    if kind == "float_parsing":
        if re.fullmatch(r"-?\d+,\d+", str(value)):
            return "expected a number with a decimal point"
        return "expected a number alone: its unit is that of the key"
    if kind in _BOUNDS:
        name, text = _BOUNDS[kind]
        bound = context[name]
        return text.format(f"{bound:g}" if isinstance(bound, float) else bound)
    if kind == "literal_error" and isinstance(value, str):
        return expected_name(value, _choices(context["expected"]))
    return _EXPECTED.get(kind, f"{first['msg'][0].lower()}{first['msg'][1:]}")


_Schema = dict[str, Any]


def _keys(schema: _Schema, path: Sequence[int | str]) -> list[str]:
    """Keys that a JSON schema has at a path of keys and indices."""
    nodes = [schema]
    for part in path:
        below: list[_Schema | None] = []
        for node in _alternatives(schema, nodes):
            below += [node.get("properties", {}).get(part), node.get("items")]
            below += node.get("prefixItems", [])
            values = node.get("additionalProperties")
            below.append(None if isinstance(values, bool) else values)
        # A part that is no key is the tag of one of several choices.
        nodes = [node for node in below if node] or _choices_of_tag(schema, nodes, part)
    keys: list[str] = []
    for node in _alternatives(schema, nodes):
        keys += node.get("properties", {})
    return list(dict.fromkeys(keys))


def _choices_of_tag(schema: _Schema, nodes: Iterable[_Schema], tag: int | str) -> list[_Schema]:
    """Choices among nodes that have a key whose only value is `tag`."""
    return [
        node
        for node in _alternatives(schema, nodes)
        if any(value.get("const") == tag for value in node.get("properties", {}).values())
    ]


def _alternatives(schema: _Schema, nodes: Iterable[_Schema]) -> Iterator[_Schema]:
    """Nodes with references followed and choices laid out."""
    for node in nodes:
        reference = str(node.get("$ref", "")).rpartition("/")[2]
        if reference:
            yield from _alternatives(schema, [schema["$defs"][reference]])
        choices = [*node.get("anyOf", []), *node.get("oneOf", []), *node.get("allOf", [])]
        yield from _alternatives(schema, choices)
        yield node
