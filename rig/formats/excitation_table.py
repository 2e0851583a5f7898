"""An excitation as a CSV file that a simulated bench and an actuator read."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError


def write_excitation(
    t_s: NDArray[np.float64], column: str, values: NDArray[np.float64], path: Path
) -> None:
    """Write times and a column of values, each (N,).

    Raises:
        InputError: The file exists already, or its folder does not.
    """
    if path.exists():
        raise InputError(f"--excitation {path}: exists already, expected a new file")
    if not path.parent.is_dir():
        raise InputError(f"--excitation {path}: expected a folder that exists")
    np.savetxt(
        path, np.column_stack([t_s, values]), "%.9g", ",", header=f"t_s,{column}", comments=""
    )
