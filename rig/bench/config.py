"""The bench's configuration: from YAML to validated values, or one line that says what is wrong."""

import re
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any, cast

import yaml
from pydantic import BaseModel, ValidationError

from rig.bench.assembly import assemble
from rig.bench.schema import BenchConfig, BenchConfigError

__all__ = ["BenchConfig", "BenchConfigError", "load_bench_config"]

MAX_CONFIG_BYTES = 1_000_000
"""Largest configuration file that is read."""

MAX_SHOWN = 60
"""Longest value that an error message shows in full."""


def load_bench_config(path: Path) -> BenchConfig:
    """Read a bench from its YAML file.

    Args:
        path: The file. Files that it names lie in its folder or below.

    Returns:
        The bench.

    Raises:
        BenchConfigError: The file cannot be read or does not describe a bench; one line naming
            file, key, value and expectation.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_CONFIG_BYTES + 1)
    except OSError as error:
        raise BenchConfigError(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) > MAX_CONFIG_BYTES:
        raise BenchConfigError(f"{path}: expected at most {MAX_CONFIG_BYTES} bytes")
    try:
        config = BenchConfig.model_validate(_parse(content), context=path.parent)
        assemble(config)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise BenchConfigError(f"{path}: not YAML: {_one_line(str(error))}") from error
    except ValidationError as error:
        raise BenchConfigError(f"{path}: {_first_error(error)}") from error
    except BenchConfigError as error:
        raise BenchConfigError(f"{path}: {error}") from error
    return config


class _Loader(yaml.SafeLoader):
    """YAML without repeated keys, and with 1e5 as a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.YAMLError(f"key {key} is given twice{node.start_mark}")
        return super().construct_mapping(node, deep)


cast("Any", _Loader).add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9]+([.][0-9]*)?[eE][-+]?[0-9]+$"),
    "-+0123456789",
)


def _parse(content: bytes) -> object:
    # An alias lets a small file stand for a huge value.
    for event in cast("Iterable[object]", cast("Any", yaml).parse(content, Loader=_Loader)):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError("aliases are not accepted")
    data: object = cast("Any", _Loader(content)).get_single_data()
    return data


def _first_error(error: ValidationError) -> str:
    errors = error.errors(include_url=False)
    # A list with a wrong entry is also reported as too short.
    errors = [part for part in errors if part["type"] != "too_short"] or errors
    first = errors[0]
    key = ".".join(str(part) for part in first["loc"])
    expected = first["msg"].removeprefix("Value error, ")
    value = first["input"]
    if first["type"] == "missing":
        line = f"{key} is missing"
    elif isinstance(value, dict | list | BaseModel):
        line = f"{key}: {expected}" if key else expected
    else:
        shown = repr(value)
        shown = shown if len(shown) <= MAX_SHOWN else f"{shown[:MAX_SHOWN]}..."
        line = f"{key} = {shown}: {expected}" if key else f"{shown}: {expected}"
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return _one_line(line) + more


def _one_line(text: str) -> str:
    return " ".join(text.split())
