"""Charts of the pages: uPlot, which draws a screen's width of points in a millisecond.

Bokeh and plotly weigh 1.3 and 4.5 MB and draw an order slower; uPlot weighs 0.1 MB, and its Python
package ships it.

Reference: https://github.com/leeoniya/uPlot
"""

from importlib import resources
from pathlib import Path

_UPLOT = Path(str(resources.files("uplot.static")))
_HERE = Path(__file__).parent

STYLES = (_UPLOT / "uPlot.min.css",)
"""Style sheets that a page with charts needs."""

SCRIPTS = (_UPLOT / "uPlot.iife.js", _HERE / "charts.js")
"""Scripts that it needs, in this order."""
