"""Quantities that the pages plot, with their units, and the plots of a run with their columns.

The report of a run, the report of a diagnosis and the live page take labels, units, columns and the
kind of each curve from here.
"""

from enum import StrEnum
from typing import NamedTuple

from rig.log.follower import FORCE_ERROR


class PlottedQuantity(NamedTuple):
    """A quantity on an axis.

    Attributes:
        name: Its name.
        unit: Its SI unit, in which the log holds it.
        shown_unit: The unit in which pages and reports show it.
        factor: Value in `shown_unit` over the value in `unit`.
        least_span: Shortest axis in `unit`: noise of a signal at rest fills no chart.
    """

    name: str
    unit: str
    shown_unit: str
    factor: float = 1.0
    least_span: float = 0.0

    @property
    def label(self) -> str:
        """Label of its axis."""
        unit = self.shown_unit
        return f"{self.name} / {f'({unit})' if '/' in unit else unit}"


TIME = PlottedQuantity("time", "s", "s")
FREQUENCY = PlottedQuantity("frequency", "Hz", "Hz")
HEIGHT = PlottedQuantity("height", "m", "mm", 1e3, 1e-3)
HEIGHT_ERROR = PlottedQuantity("height error", "m", "mm", 1e3, 2e-5)
VELOCITY = PlottedQuantity("velocity", "m/s", "m/s", 1.0, 1e-2)
FORCE = PlottedQuantity("force", "N", "N", 1.0, 2.0)
STRUT_FORCE = PlottedQuantity("strut force", "N", "N", 1.0, 2.0)
FORCE_DIFFERENCE = PlottedQuantity("force error", "N", "N", 1.0, 2.0)
VIRTUAL_FORCE = PlottedQuantity("virtual force", "N", "N", 1.0, 2.0)
RESIDUAL_FORCE = PlottedQuantity("residual force", "N", "N")
RESIDUAL_DENSITY = PlottedQuantity("residual force", "N/√Hz", "N/√Hz")
TICK_TIME = PlottedQuantity("time", "µs", "µs")

UNITS: dict[str, dict[str, tuple[float, str]]] = {
    "SI": {"m": (1e3, "mm")},
    "US": {
        "m": (1.0 / 0.0254, "in"),
        "m/s": (1.0 / 0.0254, "in/s"),
        "N": (1.0 / 4.4482216152605, "lbf"),
        "N/√Hz": (1.0 / 4.4482216152605, "lbf/√Hz"),
    },
}
"""Units that the live page can show, by SI unit: factor and name; others are shown as they are.

An inch is 0.0254 m and a pound-force 4.4482216152605 N by definition.
"""


def us_units() -> dict[str, tuple[float, str]]:
    """By a unit that reports show in SI: factor to and name of the US unit that replaces it."""
    (metre, inch), (newton, pound) = UNITS["US"]["m"], UNITS["US"]["N"]
    lengths = {"m": metre, "mm": 1e-3 * metre, "µm": 1e-6 * metre}
    rates = {"N/m": f"{pound}/{inch}", "N·s/m": f"{pound}·s/{inch}"}
    return {
        **{unit: (factor, inch) for unit, factor in lengths.items()},
        **{unit: of for unit, of in UNITS["US"].items() if unit != "m"},
        **{unit: (newton / metre, name) for unit, name in rates.items()},
        "N/K": (newton, f"{pound}/K"),
    }


class Origin(StrEnum):
    """Where the values of a curve come from."""

    MEASURED = "measured"
    MODEL = "model"
    ESTIMATED = "estimated"
    """By model and virtual force together."""

    OBSERVER = "observer"
    """Output of the observer."""

    ERROR = "error"
    """Difference of two of them."""


class LoggedCurve(NamedTuple):
    """A column of the log as a curve over time.

    Attributes:
        column: The column; one of a strut without the strut's name.
        label: Its name in the legend.
        origin: Where its values come from.
        is_of_strut: Whether each strut has this column. A column that the bench has once is drawn
            only if the model has one strut: the log does not hold to which strut it belongs.
    """

    column: str
    label: str
    origin: Origin
    is_of_strut: bool = True

    def column_of(self, strut: str) -> str:
        """Full name of the column."""
        return f"{strut}.{self.column}" if self.is_of_strut else self.column


class TimePlot(NamedTuple):
    """A plot over the time of a run.

    Attributes:
        key: Its key on the live page.
        title: Its heading there.
        quantity: Its ordinate.
        curves: Its curves, the one behind the others first.
        is_strip: Whether it shows the difference of the curves of the plot before it, in a low
            strip below them.
    """

    key: str
    title: str
    quantity: PlottedQuantity
    curves: tuple[LoggedCurve, ...]
    is_strip: bool = False


MEASURED_HEIGHT = LoggedCurve("measured_height_m", "measured", Origin.MEASURED)
MODEL_HEIGHT = LoggedCurve("height_m", "model", Origin.MODEL)
LOAD_CELL = LoggedCurve("strut_force_n", "load cell", Origin.MEASURED, is_of_strut=False)
ESTIMATED_FORCE = LoggedCurve("force_n", "estimated", Origin.ESTIMATED)
VIRTUAL_FORCE_CURVE = LoggedCurve("virtual_force_n", "virtual force", Origin.OBSERVER)
HEIGHT_ERROR_CURVE = LoggedCurve("innovation_m", "measured less predicted", Origin.ERROR)
FORCE_ERROR_CURVE = LoggedCurve(
    FORCE_ERROR, "estimated less load cell", Origin.ERROR, is_of_strut=False
)

TIME_PLOTS = (
    TimePlot("height", "Height", HEIGHT, (MEASURED_HEIGHT, MODEL_HEIGHT)),
    TimePlot("innovation", "Height error (innovation)", HEIGHT_ERROR, (HEIGHT_ERROR_CURVE,), True),
    TimePlot("force", "Strut force", STRUT_FORCE, (LOAD_CELL, ESTIMATED_FORCE)),
    TimePlot("force-error", "Force error", FORCE_DIFFERENCE, (FORCE_ERROR_CURVE,), True),
)

VIRTUAL_FORCE_PLOT = TimePlot("virtual", "Virtual force", VIRTUAL_FORCE, (VIRTUAL_FORCE_CURVE,))

MOTION_COLUMNS = {"velocity_m_per_s": VELOCITY, "height_m": HEIGHT}
"""Columns of a strut over which the live page plots its force."""

MODE_COLUMN = "mode"
FAULT_COLUMNS = {"overruns": "ticks missed", "log_fault": "log fault", "bus_fault": "bus fault"}
"""Columns that mark a fault where they are above zero, with their labels."""

TICK_CURVES = ("lateness", "work")
"""Histograms of a run's ticks, by their names in its timing record."""
