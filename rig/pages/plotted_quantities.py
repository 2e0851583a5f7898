"""Quantities that the pages plot, with their units, and the plots of a run with their columns.

The report of a run, the report of a diagnosis and the live page take labels, units, columns and the
kind of each curve from here.
"""

from enum import StrEnum
from typing import NamedTuple

from rig.bridge.values import Mode


class PlottedQuantity(NamedTuple):
    """A quantity on an axis.

    Attributes:
        name: Its name.
        unit: Its SI unit, in which the log holds it and the live page shows it.
        report_unit: Its unit in a report.
        report_factor: Value in `report_unit` over the value in `unit`.
    """

    name: str
    unit: str
    report_unit: str
    report_factor: float = 1.0

    @property
    def label(self) -> str:
        """Label of its axis on the live page."""
        return _label(self.name, self.unit)

    @property
    def report_label(self) -> str:
        """Label of its axis in a report."""
        return _label(self.name, self.report_unit)


def _label(name: str, unit: str) -> str:
    return f"{name} / {f'({unit})' if '/' in unit else unit}"


TIME = PlottedQuantity("time", "s", "s")
FREQUENCY = PlottedQuantity("frequency", "Hz", "Hz")
HEIGHT = PlottedQuantity("height", "m", "mm", 1e3)
VELOCITY = PlottedQuantity("velocity", "m/s", "m/s")
FORCE = PlottedQuantity("force", "N", "N")
STRUT_FORCE = PlottedQuantity("strut force", "N", "N")
VIRTUAL_FORCE = PlottedQuantity("virtual force", "N", "N")
RESIDUAL_FORCE = PlottedQuantity("residual force", "N", "N")
RESIDUAL_DENSITY = PlottedQuantity("residual force", "N/√Hz", "N/√Hz")
INNOVATION = PlottedQuantity("innovation", "m", "mm", 1e3)
TICK_TIME = PlottedQuantity("time", "µs", "µs")


class Origin(StrEnum):
    """Where the values of a curve come from."""

    MEASURED = "measured"
    MODEL = "model"
    ESTIMATED = "estimated"
    """By model and virtual force together."""

    OBSERVER = "observer"
    """Input or output of the observer."""


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
        quantity: Its ordinate in a report.
        live_quantity: Its ordinate on the live page, where the heading names the force.
        curves: Its curves, the one behind the others first.
    """

    key: str
    title: str
    quantity: PlottedQuantity
    live_quantity: PlottedQuantity
    curves: tuple[LoggedCurve, ...]


MEASURED_HEIGHT = LoggedCurve("measured_height_m", "measured", Origin.MEASURED)
MODEL_HEIGHT = LoggedCurve("height_m", "model", Origin.MODEL)
LOAD_CELL = LoggedCurve("strut_force_n", "load cell", Origin.MEASURED, is_of_strut=False)
ESTIMATED_FORCE = LoggedCurve("force_n", "estimated", Origin.ESTIMATED)
VIRTUAL_FORCE_CURVE = LoggedCurve("virtual_force_n", "virtual force", Origin.OBSERVER)
INNOVATION_CURVE = LoggedCurve("innovation_m", "innovation", Origin.OBSERVER)

TIME_PLOTS = (
    TimePlot("height", "Height", HEIGHT, HEIGHT, (MEASURED_HEIGHT, MODEL_HEIGHT)),
    TimePlot("force", "Strut force", STRUT_FORCE, FORCE, (LOAD_CELL, ESTIMATED_FORCE)),
    TimePlot("virtual", "Virtual force", VIRTUAL_FORCE, FORCE, (VIRTUAL_FORCE_CURVE,)),
    TimePlot("innovation", "Innovation", INNOVATION, INNOVATION, (INNOVATION_CURVE,)),
)

MOTION_COLUMNS = {"velocity_m_per_s": VELOCITY, "height_m": HEIGHT}
"""Columns of a strut over which the live page plots its force."""

MODE_COLUMN = "mode"
FAULT_COLUMNS = {"overruns": "missed ticks", "log_fault": "log fault", "bus_fault": "bus fault"}
"""Columns that mark a fault where they are above zero: their labels, the lowest level first."""

STATE_LEVELS = (*FAULT_COLUMNS.values(), *(mode.name for mode in Mode if mode is not Mode.INIT))
"""Levels of the plot of state and faults, from 0 upwards."""

FIRST_MODE_LEVEL = len(FAULT_COLUMNS) - Mode.WAITING
"""Level of a mode less its number."""

TICK_CURVES = ("lateness", "work")
"""Histograms of a run's ticks, by their names in its timing record."""
