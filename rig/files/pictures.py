"""Figures of matplotlib, whose types are incomplete."""

import contextlib
from collections.abc import Generator, Mapping
from typing import Any, cast

import matplotlib as mpl
from matplotlib.figure import Figure


@contextlib.contextmanager
def new_figure(size_in: tuple[float, float], style: Mapping[str, object]) -> Generator[Any]:
    """An empty figure of a size in inches, in a style that applies until the end of the context."""
    with cast("Any", mpl).rc_context(style):
        yield Figure(figsize=size_in, layout="constrained")
