"""A run as arrays, for a notebook or a script."""

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.log.reader import read_run

if TYPE_CHECKING:
    import pandas

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """A run of the bridge.

    Attributes:
        folder: Its folder.
        header: Content of `run.yaml`: configuration, versions, how it ended.
        t_s: Time of each tick, shape (N,).
        columns: Every column of the log by its name, which ends with its unit, shape (N,) each:
            `strut.height_m`, `strut.force_n`, `applied_force_n`, ...; NaN where there is no value.
    """

    folder: Path
    header: Mapping[str, object]
    t_s: Array
    columns: Mapping[str, Array]

    def __getitem__(self, name: str) -> Array:
        try:
            return self.columns[name]
        except KeyError:
            raise KeyError(f"{name}: expected one of {', '.join(self.columns)}") from None

    def to_pandas(self) -> "pandas.DataFrame":
        """The columns as a DataFrame over `t_s`; requires the package pandas."""
        table = importlib.import_module("pandas")
        return table.DataFrame(dict(self.columns), index=table.Index(self.t_s, name="t_s"))


def open_run(folder: Path | str) -> Run:
    """Read a run of the bridge.

    Raises:
        InputError: It is no run, or damaged.
    """
    run = read_run(Path(folder))
    steps = run.steps
    columns = {
        name: np.asarray(steps.column(name).to_numpy(), dtype=np.float64)
        for name in steps.schema.names
        if name != "t_ns"
    }
    t_s = np.asarray(steps.column("t_ns").to_numpy() * 1e-9, dtype=np.float64)
    return Run(run.folder, run.header, t_s, MappingProxyType(columns))
