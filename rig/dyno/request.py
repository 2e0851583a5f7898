"""What a user requests of the figures of a record."""

from typing import NamedTuple

STANDARD_SPEEDS_M_PER_S = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
"""Speeds at which forces are given where none are requested."""


class FigureRequest(NamedTuple):
    """Corrections, steps that are admitted, and what the curves are given at.

    Attributes:
        zero: Whether a drift of the zero is removed; else there is none.
        lag_s: The lag of the force; None estimates it from the record.
        moving_mass_kg: Mass between load cell and strut, which moves with the strut.
        warm_c: Temperatures between which a step is used; None uses all.
        reference_c: Temperature at which forces are also given; None does not.
        speeds_m_per_s: Speeds at which forces are given.
    """

    zero: bool = True
    lag_s: float | None = None
    moving_mass_kg: float = 0.0
    warm_c: tuple[float, float] | None = None
    reference_c: float | None = None
    speeds_m_per_s: tuple[float, ...] = STANDARD_SPEEDS_M_PER_S


DEFAULT = FigureRequest()
