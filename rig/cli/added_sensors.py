"""The option `--add`: virtual sensors that no configuration names."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from rig.plan.config import VirtualSensorConfig

ADDED_HELP = (
    "a name and what it reads, as under virtual_sensors of a configuration, or a YAML file with "
    "that section. Once for each."
)
"""End of the option's help."""


def read_sensors(texts: Sequence[str]) -> "dict[str, VirtualSensorConfig]":
    """Virtual sensors by name, from texts or files."""
    from can_dbc.errors import InputError
    from can_dbc.yaml_file import parse_mapping, read_text, validate
    from rig.plan.config import VirtualSensorConfig

    sensors: dict[str, VirtualSensorConfig] = {}
    for text in texts:
        source = "--add"
        if Path(text).is_file() or ":" not in text:
            source = f"--add {text}"
            section = parse_mapping(read_text(Path(text)), text).get("virtual_sensors")
            if not isinstance(section, dict):
                raise InputError(f"{source}: expected a section virtual_sensors")
            given = cast("dict[str, object]", section)
        else:
            given = parse_mapping(text, source)
        for name, item in given.items():
            sensors[name] = validate(VirtualSensorConfig, item, f"{source}: {name}")
    return sensors
