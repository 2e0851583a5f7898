"""Whether a further sensor is to be trusted: its readings within the gate, and beyond it."""

from typing import NamedTuple

GATE = 6.0
"""Of a reading, in its standard deviations: two in a thousand million are beyond it by chance."""

SILENT = 5
"""Intervals without a reading after which a sensor counts as silent."""

_BEYOND, _WITHIN = 5, 50
"""Readings in a row that leave a sensor out, and that let it in again: a single one may be a fault
of its frame, and one that comes and goes is not to be trusted."""


class SensorHealth(NamedTuple):
    """Health of a further sensor: its last readings in a row beyond the gate, or within it."""

    t_ns: int
    beyond: int = 0
    within: int = 0
    is_out: bool = False

    def update(self, t_ns: int, *, is_within: bool, counts: bool) -> "SensorHealth":
        """Health after another reading; `counts`: it counts for a sensor that is out."""
        if self.is_out and not counts:
            return self._replace(t_ns=t_ns)
        beyond, within = (0, self.within + 1) if is_within else (self.beyond + 1, 0)
        is_out = within < _WITHIN if self.is_out else beyond >= _BEYOND
        return SensorHealth(t_ns, beyond, within, is_out)
