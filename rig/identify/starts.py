"""Where the search for a law's parameters begins, read off the motion itself.

Each start holds all parameters of a law; those in which the force is proportional (`Effect.scaled`)
stand for a force of arbitrary size, which a linear fit sets.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from rig.identify.least_squares import Space

Array = NDArray[np.float64]
Start = tuple[float, ...]


class Motion(NamedTuple):
    """What a strut did.

    Attributes:
        z: Heights in m, shape (N,).
        v: Velocities in m/s, shape (N,).
        free_length_m: Free length of the strut.
        stiffness_n_per_m: Its stiffness.
        damping_n_s_per_m: Its damping.
        duration_s: Length of the longest run.
        temperatures_c: Lowest and highest temperature; equal where none was measured.
        tones: Frequency (Hz) and phase (rad) of the strongest lines of the missing force.
        mass_kg: Mass that the strut moves.
        least_stroke_m: Stroke of the run with the smallest one; the whole stroke if zero.
    """

    z: Array
    v: Array
    free_length_m: float
    stiffness_n_per_m: float
    damping_n_s_per_m: float
    duration_s: float
    temperatures_c: tuple[float, float]
    tones: tuple[tuple[float, float], ...]
    mass_kg: float
    least_stroke_m: float = 0.0

    @property
    def low(self) -> float:
        """Lowest height."""
        return float(self.z.min())

    @property
    def high(self) -> float:
        """Highest height."""
        return float(self.z.max())

    @property
    def stroke(self) -> float:
        """Highest less lowest height."""
        return self.high - self.low

    @property
    def least_stroke(self) -> float:
        """Stroke of the run with the smallest one."""
        return self.least_stroke_m or self.stroke

    @property
    def speed(self) -> float:
        """Root mean square of the velocity."""
        return float(np.sqrt(np.mean(self.v**2)))

    def heights(self, *shares: float) -> list[float]:
        """Heights at shares of the stroke."""
        return [self.low + share * self.stroke for share in shares]


def _grid(*axes: Sequence[float]) -> list[Start]:
    return list(itertools.product(*axes))


def _bump(m: Motion) -> list[Start]:
    return _grid(m.heights(0.03, 0.07, 0.12, 0.18, 0.26, 0.36), [1.0], [0.002, 0.02])


def _rebound(m: Motion) -> list[Start]:
    return _grid(m.heights(0.97, 0.93, 0.88, 0.82, 0.74, 0.64), [1.0], [0.002, 0.02])


def _hertz_bump(m: Motion) -> list[Start]:
    return _grid(m.heights(0.04, 0.1, 0.16, 0.24, 0.36), [1.0], [0.05, 0.3])


def _hertz_rebound(m: Motion) -> list[Start]:
    return _grid(m.heights(0.96, 0.9, 0.84, 0.76, 0.64), [1.0], [0.05, 0.3])


def _ends(m: Motion) -> list[Start]:
    return [
        (low, high, 1.0, 0.005)
        for low, high in zip(m.heights(0.04, 0.1, 0.18), m.heights(0.96, 0.9, 0.82), strict=True)
    ]


def _hertz_ends(m: Motion) -> list[Start]:
    return [(low, high, k, 0.2) for low, high, k, _ in _ends(m)]


def _power_bump(m: Motion) -> list[Start]:
    return _grid(m.heights(0.05, 0.15, 0.3), [1.0], [1.0, 2.0], [0.1])


def _power_rebound(m: Motion) -> list[Start]:
    return _grid(m.heights(0.95, 0.85, 0.7), [1.0], [1.0, 2.0], [0.1])


def _gas(m: Motion) -> list[Start]:
    deepest = max(m.free_length_m - m.low, 0.25 * m.stroke)
    return _grid([1.0], [deepest * share for share in (1.15, 1.5, 2.0, 4.0)], [1.0, 1.4])


def _backlash(m: Motion) -> list[Start]:
    gaps = [0.08 * m.stroke, 0.25 * m.stroke, 0.5 * m.stroke]
    return _grid([1.0], gaps, [m.free_length_m, *m.heights(0.3, 0.5, 0.7)])


def _free_play(m: Motion) -> list[Start]:
    gaps = [0.03 * m.stroke, 0.1 * m.stroke, 0.3 * m.stroke]
    return _grid([m.free_length_m, *m.heights(0.35, 0.5, 0.65)], gaps)


def _bristles(m: Motion) -> list[float]:
    return [x for x in (2e-5, 8e-5, 3e-4, 1e-3) if x <= 0.02 * m.stroke] or [0.01 * m.stroke]


def _bends(m: Motion) -> list[float]:
    return [m.stroke * share for share in (0.03, 0.1, 0.3)]


def _stribeck(m: Motion) -> list[Start]:
    return _grid([1.0], [1.3], [0.02, 0.1 * m.speed, 0.3 * m.speed], [2e-3, 0.02 * m.speed])


def _lugre(m: Motion) -> list[Start]:
    bristles = _bristles(m)[:2]
    speeds = [0.02, 0.2 * m.speed]
    return [(1.0, 1.2, speed, bristle, 0.002 / bristle) for speed in speeds for bristle in bristles]


def _temperature(m: Motion) -> list[Start]:
    cold, hot = m.temperatures_c
    if hot - cold < 1.0:
        return []
    return _grid([0.003, 0.015, -0.005], [cold, 20.0])


def _linear_temperature(m: Motion) -> list[Start]:
    cold, hot = m.temperatures_c
    return [] if hot - cold < 1.0 else [(0.01, cold), (0.01, 20.0)]


def _energy(m: Motion) -> list[Start]:
    work = m.damping_n_s_per_m * float(np.mean(m.v**2)) * m.duration_s
    if work <= 0.0:
        return []
    return _grid([0.9, 0.5], [0.1 * work, 0.3 * work, work])


def _time_fade(m: Motion) -> list[Start]:
    if m.damping_n_s_per_m <= 0.0:
        return []
    return _grid([0.9, 0.5], [0.1 * m.duration_s, 0.3 * m.duration_s, m.duration_s])


def _hidden_mass(_: Motion) -> list[Start]:
    frequencies: list[float] = np.geomspace(0.4, 25.0, 16).tolist()
    return _grid([1.0], frequencies, [0.01, 0.06], [9.81])


def _always(*starts: Start) -> Callable[[Motion], list[Start]]:
    def fixed(_: Motion) -> list[Start]:
        return list(starts)

    return fixed


def _knees(*shares: float) -> Callable[[Motion], list[Start]]:
    def knees(m: Motion) -> list[Start]:
        return [(1.0, share * m.speed) for share in shares]

    return knees


_ONE = _always((1.0,))

_STARTS: Mapping[str, Callable[[Motion], list[Start]]] = MappingProxyType(
    {
        "preload": _ONE,
        "linear_stiffness": _ONE,
        "linear_damping": _ONE,
        "added_mass": _ONE,
        "inerter": _ONE,
        "input_gain": _ONE,
        "quadratic_stiffness": _ONE,
        "cubic_stiffness": _ONE,
        "centred_cubic_stiffness": lambda m: _grid([1.0], m.heights(0.1, 0.3, 0.5, 0.7, 0.9)),
        "power_stiffness": lambda _: _grid([1.0], [1.5, 2.5, 3.5, 5.0]),
        "progressive_stiffness": lambda m: _grid([1.0], [m.stroke * s for s in (0.1, 0.25, 0.6)]),
        "exponential_stiffness": lambda m: _grid([1.0], [m.stroke * s for s in (0.1, 0.25, 0.6)]),
        "gas_spring": _gas,
        "balanced_gas_spring": _gas,
        "bump_stop": _bump,
        "rebound_stop": _rebound,
        "hertz_bump_stop": _hertz_bump,
        "hertz_rebound_stop": _hertz_rebound,
        "power_bump_stop": _power_bump,
        "power_rebound_stop": _power_rebound,
        "end_stops": _ends,
        "hertz_end_stops": _hertz_ends,
        "backlash": _backlash,
        "free_play": _free_play,
        "coulomb_friction": lambda m: _grid([1.0], [1e-3, 0.02 * m.speed, 0.1 * m.speed]),
        "stribeck_friction": _stribeck,
        "presliding_friction": lambda m: _grid([1.0], _bristles(m)),
        "elastoplastic_friction": lambda m: _grid([1.0], _bristles(m)),
        "lugre_friction": _lugre,
        "quadratic_damping": _ONE,
        "power_damping": lambda _: _grid([1.0], [0.5, 1.5, 2.5]),
        "asymmetric_damping": _always((1.0, 0.0), (0.0, 1.0), (1.0, -1.0)),
        "digressive_damping": _knees(0.2, 0.6, 1.5),
        "saturating_damping": lambda m: _grid([1.0], [0.3 * m.speed, m.speed], [1.0, 4.0]),
        "arctan_damping": _knees(0.2, 0.6, 1.5),
        "blow_off_damping": _knees(0.2, 0.5, 1.0, 1.8),
        "smooth_blow_off_damping": _knees(0.2, 0.6, 1.5),
        "stroke_damping": _ONE,
        "position_dependent_damping": _ONE,
        "zone_damping": lambda m: _grid(
            [1.0], m.heights(0.1, 0.3, 0.5, 0.7, 0.9), [0.1 * m.stroke, 0.3 * m.stroke]
        ),
        "end_zone_damping": lambda m: _grid(
            [1.0], [m.free_length_m, *m.heights(0.2, 0.4, 0.6, 0.8)]
        ),
        "bouc_wen": lambda m: [
            (1.0, 0.015 * m.least_stroke, 1.0, 0.5),
            *_grid([1.0], _bends(m), [1.0, 2.0], [0.5, 0.9]),
        ],
        "dahl": lambda m: _grid([1.0], [0.015 * m.least_stroke, *_bends(m)], [1.0]),
        "iwan": lambda m: _grid([1.0], [0.015 * m.least_stroke, *_bends(m)]),
        "maxwell": lambda _: _grid([1.0], [0.005, 0.02, 0.06, 0.2, 0.6, 2.0]),
        "temperature_fade": _temperature,
        "linear_temperature_fade": _linear_temperature,
        "time_fade": _time_fade,
        "energy_fade": _energy,
        "delay": _always((0.0005,), (0.002,), (0.005,), (0.015,), (0.04,)),
        "periodic_force": lambda m: [(1.0, f, phase) for f, phase in m.tones],
        "hidden_mass": _hidden_mass,
    }
)

CANDIDATES = tuple(name for name in CATALOGUE if name not in ("none", "restoring_surface"))
"""Effects that compete."""


def starts(name: str, motion: Motion) -> list[Start]:
    """Where to begin with an effect; empty where the run cannot show it."""
    return _STARTS[name](motion)


def space(name: str, motion: Motion, values: Array) -> Space:
    """Where to search an effect's parameters, beginning at `values`.

    Heights are searched within the stroke, and what would turn one family into another (friction
    whose bristle is as long as a hysteresis loop, say) is left to that other family.
    """
    item = effect(name)
    low = np.array([parameter.low for parameter in item.parameters])
    high = np.array([parameter.high for parameter in item.parameters])
    for i, parameter in enumerate(item.parameters):
        narrower = _narrower(name, parameter.name, motion)
        if narrower is not None:
            low[i], high[i] = max(low[i], narrower[0]), min(high[i], narrower[1])
    scale = np.maximum(np.abs(values), 1e-9)
    for i, parameter in enumerate(item.parameters):
        if parameter.unit == "m":
            scale[i] = max(motion.stroke, 1e-9)
        if parameter.unit == "rad":
            scale[i] = 1.0
    return Space(low, high, scale, low > 0.0)


def _narrower(name: str, key: str, m: Motion) -> tuple[float, float] | None:
    if key == "low_contact_height_m":
        return m.low - 0.02 * m.stroke, m.low + 0.3 * m.stroke
    if key == "high_contact_height_m":
        return m.high - 0.3 * m.stroke, m.high + 0.02 * m.stroke
    if key in ("contact_height_m", "zone_height_m"):
        return m.low - 0.02 * m.stroke, m.high + 0.02 * m.stroke + max(
            0.0, m.free_length_m - m.high if key == "zone_height_m" else 0.0
        )
    if key == "centre_height_m":
        return m.low - m.stroke, m.high + m.stroke
    if key == "gap_m":
        # Play that takes most of the stroke is a pair of stops.
        return 1e-5, 0.6 * m.stroke
    if key == "rounding_velocity_m_per_s":
        return 1e-4, max(2e-4, 0.12 * m.speed)
    if key == "presliding_m":
        return 1e-6, max(2e-6, 0.012 * m.stroke)
    if key == "stribeck_velocity_m_per_s":
        return 1e-3, max(2e-3, m.speed)
    if key == "yield_displacement_m":
        return 0.012 * m.least_stroke, 3.0 * m.stroke
    if key == "knee_velocity_m_per_s":
        return max(1e-3, 0.08 * m.speed), max(2e-3, 6.0 * m.speed)
    if key == "width_m":
        return 0.03 * m.stroke, 1.5 * m.stroke
    if key == "gas_length_m":
        return max(0.02, 1.02 * (m.free_length_m - m.low)), 10.0
    if key == "length_m":
        return max(0.005, 0.04 * m.stroke), 4.0 * m.stroke
    if name == "hidden_mass" and key == "mass_kg":
        return 1e-4 * m.mass_kg, 3.0 * m.mass_kg
    return None
