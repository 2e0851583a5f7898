"""A recording of a bench: what was measured in one run."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.recordings.gaps import Gaps

Array = NDArray[np.float64]


class RecordingError(InputError):
    """A recording that cannot be diagnosed; one line: file, column, fault, what was expected."""


@dataclass(frozen=True)
class Recording:
    """One run of a bench, as measured.

    Attributes:
        t_s: Times, increasing, shape (N,).
        heights_m: Heights of the struts, shape (N, struts); NaN where a sample is missing.
        applied_force_n: Applied force, shape (N,), or None where the bench has none.
        strut_forces_n: Load-cell force of each strut, shape (N, struts), a column of NaN for a
            strut without a cell; None where there is no cell.
        temperature_c: Damper temperature, shape (N,), or None.
        force_gaps: Gaps of the applied force, over which it is interpolated here; None for none.
        sha256: Of the file, or of the run's steps, in hex; None where it was not read from one.
    """

    name: str
    t_s: Array
    heights_m: Array
    applied_force_n: Array | None = None
    strut_forces_n: Array | None = None
    temperature_c: Array | None = None
    force_gaps: Gaps | None = None
    sha256: str | None = None

    @property
    def duration_s(self) -> float:
        """Time from first to last sample."""
        return float(self.t_s[-1] - self.t_s[0])
