"""Where a condition holds along a recording."""

import numpy as np
from numpy.typing import NDArray


def find_stretches(holds: NDArray[np.bool_]) -> list[slice]:
    """The stretches in which a condition (N,) holds, in their order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], holds.astype(np.int8), [0]]))).tolist()
    return [slice(*pair) for pair in zip(edges[::2], edges[1::2], strict=True)]
