"""Every quantity that a bench may send, each declared here and nowhere else.

What stands in the table can be named under `signals` of a configuration; it reaches the core, the
log, its replay and its exports under its own name.
"""

from dataclasses import dataclass

from can_dbc.units import Dimension


@dataclass(frozen=True)
class Quantity:
    """A measured quantity.

    Attributes:
        key: Its key under `signals`.
        column: Its column in the log and in a CSV of measured data, with the unit; a
            height's in the log is `measured_height_m`, after its strut's name.
        dimension: What a signal of it measures; its unit is converted to SI.
        words: The quantity as it is called in a sentence.
    """

    key: str
    column: str
    dimension: Dimension
    words: str


HEIGHT = Quantity("height", "height_m", Dimension.LENGTH, "height")
"""Height of a strut, one for each strut; it has a time of its own."""

APPLIED_FORCE = Quantity("applied_force", "applied_force_n", Dimension.FORCE, "applied force")
LOAD_CELL_FORCE = Quantity(
    "load_cell_force", "strut_force_n", Dimension.FORCE, "force of the load cell"
)
TEMPERATURE = Quantity(
    "temperature", "temperature_c", Dimension.TEMPERATURE, "temperature of the damper"
)

OTHERS = (APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE)
"""All but heights, in the order in which a step is given them."""

FURTHER = {
    "height": Quantity("height", "measured_height_m", Dimension.LENGTH, "further height"),
    "velocity": Quantity("velocity", "measured_velocity_m_per_s", Dimension.VELOCITY, "velocity"),
    "force": Quantity("force", "measured_force_n", Dimension.FORCE, "force"),
}
"""What a further sensor of a strut may measure, by what `measures` says in a configuration; the
column is that of the log, after the names of strut and sensor."""

ALARM = Quantity("alarm", "alarm", Dimension.NUMBER, "alarm of a device")
"""A signal whose raw value is other than zero while something is wrong with its device."""

PLACES = {quantity: place for place, quantity in enumerate(OTHERS)}
"""Where each stands among `OTHERS`."""
