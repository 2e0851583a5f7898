"""A recording of a bench: what was measured in one run."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.channels.measured_quantities import APPLIED_FORCE, Quantity
from rig.recordings.gaps import Gaps, combine_gaps

Array = NDArray[np.float64]


class RecordingError(InputError):
    """A recording that cannot be diagnosed; one line: file, column, fault, what was expected."""


@dataclass(frozen=True)
class RecordedInput:
    """What drove a bench, as measured.

    Attributes:
        quantity: A force, a torque, or the motion of a body.
        values: In N, N·m or m, shape (N,).
        acceleration_m_per_s2: Of a motion, where it was measured, shape (N,); else None.
        gaps: Gaps, over which the values are interpolated here; None where it is not known.
    """

    quantity: Quantity
    values: Array
    acceleration_m_per_s2: Array | None = None
    gaps: Gaps | None = None


@dataclass(frozen=True)
class Recording:
    """One run of a bench, as measured.

    Attributes:
        t_s: Times, increasing, shape (N,).
        heights_m: Heights of the struts, shape (N, struts); NaN where a sample is missing.
        inputs: What drove the bench, by the names of the model's inputs, empty where its motion is
            prescribed. A force that the recording does not name is called `applied_force`.
        strut_forces_n: Load-cell force of each strut, shape (N, struts), a column of NaN for a
            strut without a cell; None where there is no cell.
        temperature_c: Damper temperature, shape (N,), or None.
        sha256: Of the file, or of the run's steps, in hex; None where it was not read from one.
        delays_s: Delays that its times are free of already, by channel, as ``height_m:strut``.
    """

    name: str
    t_s: Array
    heights_m: Array
    inputs: Mapping[str, RecordedInput] = field(default_factory=dict[str, RecordedInput])
    strut_forces_n: Array | None = None
    temperature_c: Array | None = None
    sha256: str | None = None
    delays_s: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def applied_force_n(self) -> Array | None:
        """The only force that drove it, shape (N,); None where there is none, or more than one."""
        forces = [item for item in self.inputs.values() if item.quantity is APPLIED_FORCE]
        return forces[0].values if len(forces) == 1 else None

    @property
    def gaps(self) -> Gaps | None:
        """Gaps of the inputs; None where none is known."""
        known = [item.gaps for item in self.inputs.values() if item.gaps is not None]
        return combine_gaps(known) if known else None

    @property
    def duration_s(self) -> float:
        """Time from first to last sample."""
        return float(self.t_s[-1] - self.t_s[0])
