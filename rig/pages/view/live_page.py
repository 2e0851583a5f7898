"""The live page: its HTML, with the plots that its script draws."""

from rig.pages.html import render
from rig.pages.plotted_quantities import (
    ESTIMATED_FORCE,
    FAULT_COLUMNS,
    FIRST_MODE_LEVEL,
    FORCE,
    FREQUENCY,
    LOAD_CELL,
    MODE_COLUMN,
    MOTION_COLUMNS,
    STATE_LEVELS,
    TICK_CURVES,
    TICK_TIME,
    TIME,
    TIME_PLOTS,
    VIRTUAL_FORCE_CURVE,
)


def live_page() -> str:
    """Text of the page."""
    return render("view/page.html", plots=TIME_PLOTS, motions=MOTION_COLUMNS, table=_table())


def _table() -> dict[str, object]:
    """Plots as the page's script reads them."""
    curves = [
        curve._asdict() | {"plot": plot.key, "unit": plot.live_quantity.unit}
        for plot in TIME_PLOTS
        for curve in plot.curves
    ]
    return {
        "time": TIME.label,
        "time_unit": TIME.unit,
        "curves": curves,
        "labels": {plot.key: plot.live_quantity.label for plot in TIME_PLOTS},
        "state": {
            "columns": [MODE_COLUMN, *FAULT_COLUMNS],
            "levels": STATE_LEVELS,
            "first_mode_level": FIRST_MODE_LEVEL,
        },
        "planes": {
            "force": FORCE.label,
            "motions": {
                column: quantity._asdict() | {"label": quantity.label}
                for column, quantity in MOTION_COLUMNS.items()
            },
            "estimated": ESTIMATED_FORCE.label,
            "measured": LOAD_CELL.label,
        },
        "spectrum": {
            "frequency": FREQUENCY._asdict() | {"label": FREQUENCY.label},
            "label": VIRTUAL_FORCE_CURVE.label,
        },
        "ticks": {"time": TICK_TIME.label, "time_unit": TICK_TIME.unit, "curves": TICK_CURVES},
    }
