"""The bench's configuration: from YAML to validated values."""

from pathlib import Path

from can_dbc.yaml_file import load_yaml
from rig.files.file_kinds import FILE_KINDS
from rig.simulated_bench.assembly import assemble
from rig.simulated_bench.schema import BenchConfig, BenchConfigError

__all__ = ["BenchConfig", "BenchConfigError", "load_bench_config"]


def load_bench_config(path: Path) -> BenchConfig:
    """Read a bench from its YAML file; files that it names lie in its folder or below.

    Raises:
        InputError: The file cannot be read or does not describe a bench; one line naming file,
            key, value and expectation.
    """
    config = load_yaml(BenchConfig, path, path.parent, FILE_KINDS)
    try:
        assemble(config)
    except BenchConfigError as error:
        raise BenchConfigError(f"{path}: {error}") from error
    return config
