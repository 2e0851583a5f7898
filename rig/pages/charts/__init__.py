"""Charts of the pages, drawn by uPlot.

It weighs 0.1 MB, which a report carries along, where Bokeh weighs 1.3 and plotly 4.5; its Python
package ships it.

Reference: https://github.com/leeoniya/uPlot
"""

from importlib import resources
from pathlib import Path

_UPLOT = Path(str(resources.files("uplot.static")))
_HERE = Path(__file__).parent

STYLES = (_UPLOT / "uPlot.min.css", _HERE / "charts.css")
"""Style sheets that a page with charts needs."""

SCRIPTS = (_UPLOT / "uPlot.iife.js", _HERE / "charts.js")
"""Scripts that it needs, in this order."""
