"""Compilation of the bench's functions to machine code, which numba keeps on disk."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rig.files.numba_alone import numba

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_P = ParamSpec("_P")
_R = TypeVar("_R")

_PACKAGE_STAMP = tuple(
    sorted(
        (path.name, path.stat().st_mtime, path.stat().st_size)
        for path in Path(__file__).parent.glob("*.py")
    )
)


def jit_compile(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function to machine code, typed as it was."""
    dispatcher = cast("Any", numba).njit(cache=True, error_model="numpy")(function)
    # numba renews what is on disk when the function's own file changes. What it calls is compiled
    # into it, so a change of any file of this package has to renew it as well.
    dispatcher._cache._cache_file._source_stamp = _PACKAGE_STAMP  # noqa: SLF001
    return cast("Callable[_P, _R]", dispatcher)
