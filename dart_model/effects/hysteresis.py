"""Forces with memory of where the strut has been."""

import math

from dart_model.effects.contract import Effect, Floats, Parameter, Writable

_FAMILY = "hysteresis"
_LOOPS = "loops of different amplitude and frequency"
# A loop that turned the other way would make energy out of nothing.
_LIMIT = Parameter("yield_force_n", "N", 0.0, 1e5, "force at which the loop is fully bent")
_BEND = Parameter("yield_displacement_m", "m", 1e-5, 1.0, "travel from rest to full force")

ELEMENTS = 8
"""Slip elements of the Iwan model."""

# See friction.py: what settles faster (1/s) cannot be seen.
_FASTEST_SETTLING_PER_S = 2000.0


def _bouc_wen(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * state[0]


def _bouc_wen_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    # The state is the force in units of `yield_force_n`.
    speed = velocity_m_per_s / p[1]
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    ratio = min(abs(state[0]), 1.5) ** p[2]
    same_way = 1.0 if velocity_m_per_s * state[0] > 0.0 else -1.0
    out[0] = limited * (1.0 - ratio * (p[3] * same_way + 1.0 - p[3]))


def _dahl(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * state[0]


def _dahl_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    speed = velocity_m_per_s / p[1]
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    rest = 1.0 - math.copysign(state[0], state[0] * velocity_m_per_s)
    out[0] = limited * math.copysign(abs(rest) ** p[2], rest)


def _iwan(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    total = 0.0
    for i in range(ELEMENTS):
        limit = 2.0 * (i + 1.0) / (ELEMENTS * (ELEMENTS + 1.0))
        total += min(max(state[i], -limit), limit)
    return -p[0] * total


def _iwan_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    # Elements of equal stiffness slip one after another; each state is an element's share of the
    # force, elastic up to its limit. A step that overshoots the limit is led back to it.
    speed = velocity_m_per_s / (p[1] * ELEMENTS)
    for i in range(ELEMENTS):
        limit = 2.0 * (i + 1.0) / (ELEMENTS * (ELEMENTS + 1.0))
        beyond = abs(state[i]) - limit
        if beyond > 0.0 and velocity_m_per_s * state[i] > 0.0:
            out[i] = -math.copysign(300.0 * beyond, state[i])
        else:
            out[i] = speed


def _maxwell(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    # The state is the spring's deflection in m.
    return -p[0] * state[0]


def _maxwell_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    out[0] = velocity_m_per_s - state[0] / p[1]


BOUC_WEN = Effect(
    name="bouc_wen",
    family=_FAMILY,
    parameters=(
        _LIMIT,
        _BEND,
        Parameter("exponent", "", 0.8, 10.0, "sharpness of the bend"),
        Parameter("shape", "", 0.0, 1.0, "0.5: unloading is elastic"),
    ),
    force=_bouc_wen,
    excitation=_LOOPS,
    reference="Ikhouane and Rodellar, Systems with Hysteresis (2007)",
    rate=_bouc_wen_rate,
    state_size=1,
)

DAHL = Effect(
    name="dahl",
    family=_FAMILY,
    parameters=(_LIMIT, _BEND, Parameter("exponent", "", 0.3, 4.0, "sharpness of the bend")),
    force=_dahl,
    excitation=_LOOPS,
    reference="Dahl, Solid friction damping of mechanical vibrations, AIAA J. 14 (1976)",
    rate=_dahl_rate,
    state_size=1,
)

IWAN = Effect(
    name="iwan",
    family=_FAMILY,
    parameters=(_LIMIT, _BEND),
    force=_iwan,
    excitation=_LOOPS,
    reference="Iwan, A distributed-element model for hysteresis, J. Appl. Mech. 33 (1966)",
    rate=_iwan_rate,
    state_size=ELEMENTS,
)

MAXWELL = Effect(
    name="maxwell",
    family=_FAMILY,
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", 0.0, 1e7, "spring in series with a damper"),
        Parameter("relaxation_time_s", "s", 2e-3, 100.0, "damping over stiffness"),
    ),
    force=_maxwell,
    excitation="frequencies above and below the inverse of the relaxation time",
    reference="Flügge, Viscoelasticity (1975), 1.2",
    rate=_maxwell_rate,
    state_size=1,
)
