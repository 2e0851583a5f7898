"""One thread for linear algebra, while a computation has threads of its own."""

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import threadpoolctl

_P = ParamSpec("_P")
_R = TypeVar("_R")


def with_one_blas_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A function that runs with one thread for linear algebra.

    Several would wait for one another in a loop: for narrow matrices that takes twice the time.
    """

    @functools.wraps(function)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        # At each call, as libraries that are loaded later have threads, too.
        with cast("Any", threadpoolctl).threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
