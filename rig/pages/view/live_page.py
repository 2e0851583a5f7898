"""The live page: its HTML, with the plots that its script draws."""

from rig.bridge.values import Mode
from rig.pages.html import render
from rig.pages.mode_words import COUNT_WORDS, TONES
from rig.pages.plotted_quantities import (
    ESTIMATED_FORCE,
    FAULT_COLUMNS,
    FORCE,
    FREQUENCY,
    LOAD_CELL,
    MODE_COLUMN,
    MOTION_COLUMNS,
    TICK_CURVES,
    TICK_TIME,
    TIME,
    TIME_PLOTS,
    UNITS,
    VIRTUAL_FORCE_CURVE,
    VIRTUAL_FORCE_PLOT,
)


def live_page() -> str:
    """Text of the page."""
    return render("view/page.html", plots=TIME_PLOTS, motions=MOTION_COLUMNS, table=_table())


def _table() -> dict[str, object]:
    """Plots as the page's script reads them."""
    plots = (*TIME_PLOTS, VIRTUAL_FORCE_PLOT)
    curves = [curve._asdict() | {"plot": plot.key} for plot in plots for curve in plot.curves]
    return {
        "time_unit": TIME.unit,
        "curves": curves,
        "plots": {
            plot.key: plot.quantity._asdict() | {"is_strip": plot.is_strip} for plot in plots
        },
        "units": UNITS,
        "band": {
            "columns": [MODE_COLUMN, *FAULT_COLUMNS],
            "faults": list(FAULT_COLUMNS.values()),
            "modes": {mode.value: [mode.name, TONES[mode].name] for mode in Mode},
        },
        "planes": {
            "force": FORCE._asdict(),
            "motions": {column: it._asdict() for column, it in MOTION_COLUMNS.items()},
            "estimated": ESTIMATED_FORCE.label,
            "measured": LOAD_CELL.label,
        },
        "counts": dict(COUNT_WORDS),
        "spectrum": {"frequency": FREQUENCY._asdict(), "label": VIRTUAL_FORCE_CURVE.label},
        "ticks": {"time": TICK_TIME.label, "time_unit": TICK_TIME.unit, "curves": TICK_CURVES},
    }
