"""Figures of matplotlib, whose types are incomplete."""

import contextlib
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any, cast

# matplotlib takes settings from a `matplotlibrc` of the working directory.
with contextlib.chdir(Path(__file__).parent):
    import matplotlib as mpl
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.figure import Figure

__all__ = ["AutoDateLocator", "ConciseDateFormatter", "Figure", "new_figure"]


@contextlib.contextmanager
def new_figure(size_in: tuple[float, float], style: Mapping[str, object]) -> Generator[Any]:
    """An empty figure of a size in inches, in a style that applies until the end of the context."""
    with cast("Any", mpl).rc_context(style):
        yield Figure(figsize=size_in, layout="constrained")
