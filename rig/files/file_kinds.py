"""What a YAML file is, by a key that only files of its kind have."""

from collections.abc import Mapping
from types import MappingProxyType

FILE_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "masses": "a simulated bench: `rig bench` runs it",
        "skeleton": "a model: `model:` of a configuration, or --model, names it",
        "signals": "a configuration of the bridge: `rig run` runs it",
    }
)
