"""Recordings and models of the same bench in other units, mirrored, cut, later."""

import re
from dataclasses import dataclass, replace

import numpy as np

from tests.diagnosis.driven import driven_by

_SUPERSCRIPTS = str.maketrans("²³", "23")
_BASE = {
    "": (0, 0, 0),
    "rad": (0, 0, 0),
    "K": (0, 0, 0),
    "m": (1, 0, 0),
    "N": (0, 1, 0),
    "s": (0, 0, 1),
    "Hz": (0, 0, -1),
    "J": (1, 1, 0),
    "kg": (-1, 1, 2),
}
"""Exponents of length, force and time."""


@dataclass(frozen=True)
class Scale:
    """Factors by which length, force and time are multiplied."""

    length: float
    force: float
    time: float

    def factor(self, unit):
        """Factor of a quantity with the unit, e.g. ``N·s²/m²``."""
        total = 1.0
        for sign, part in zip((1, -1), [*unit.split("/"), ""], strict=False):
            for token in part.split("·"):
                symbol, exponent = _symbol(token)
                for base, power in zip(
                    (self.length, self.force, self.time), _BASE[symbol], strict=True
                ):
                    total *= base ** (sign * power * exponent)
        return total

    def recording(self, record):
        """The recording of the scaled bench."""
        applied, forces = record.applied_force_n, record.strut_forces_n
        return replace(
            record,
            t_s=record.t_s * self.time,
            heights_m=record.heights_m * self.length,
            inputs={} if applied is None else driven_by(applied * self.force),
            strut_forces_n=None if forces is None else forces * self.force,
        )

    def model(self, bench, **kwargs):
        """Nominal model of the scaled bench, `bench` being a module with a model."""
        mass = kwargs.pop("mass", getattr(bench, "MASS", 3.0))
        return bench.model(
            mass=mass * self.factor("kg"),
            stiffness=kwargs.pop("stiffness", bench.STIFFNESS) * self.factor("N/m"),
            damping=kwargs.pop("damping", bench.DAMPING) * self.factor("N·s/m"),
            free=bench.FREE * self.length,
            gravity=kwargs.pop("gravity", bench.GRAVITY) * self.length / self.time**2,
            **kwargs,
        )


def _symbol(token):
    """Symbol and exponent of, e.g., ``m²`` or ``m^1.5``."""
    match = re.fullmatch(r"([A-Za-z]*|1)\^?([\d.]*)", token.translate(_SUPERSCRIPTS))
    assert match, token
    symbol, exponent = match.groups()
    return "" if symbol == "1" else symbol, float(exponent or 1)


def mirrored(record, about_m):
    """Heights mirrored about a height, and forces turned over."""
    applied, forces = record.applied_force_n, record.strut_forces_n
    return replace(
        record,
        heights_m=2.0 * about_m - record.heights_m,
        inputs={} if applied is None else driven_by(-applied),
        strut_forces_n=None if forces is None else -forces,
    )


def cut(record):
    """A recording's two halves."""
    half = len(record.t_s) // 2
    return (
        replace(_rows(record, slice(0, half)), name=f"{record.name}a"),
        replace(_rows(record, slice(half, None)), name=f"{record.name}b"),
    )


def thinned(record, every):
    """Each n-th sample of a recording."""
    return _rows(record, slice(None, None, every))


def _rows(record, rows):
    arrays = {
        key: None if getattr(record, key) is None else getattr(record, key)[rows]
        for key in ("t_s", "heights_m", "strut_forces_n", "temperature_c")
    }
    applied = record.applied_force_n
    return replace(record, inputs={} if applied is None else driven_by(applied[rows]), **arrays)


def shifted(record, by_s):
    return replace(record, t_s=record.t_s + np.float64(by_s))
