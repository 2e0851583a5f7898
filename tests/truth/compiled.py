"""The planted laws and the steps in time, in scalar arithmetic compiled by numba.

Both stand in one file because numba's cache knows only the file of a function: a law changed in
another file would live on in what was compiled before.

Time is stepped with the classical Runge-Kutta method of fourth order; the load is known at every
step and half step, exactly, so no hold or interpolation enters. Sticking is an event.

A law is a number here; `CODES` gives it a name and its parameters in the order in which the law
reads them. `x` is the height over the free length, positive in extension; forces are positive when
they push the strut's bodies apart (up, on this bench).

Literature:
    Canudas de Wit et al. 1995 (LuGre); Karnopp 1985 (stick as a state of its own);
    Hunt and Crossley 1975 (contact, exponent 3/2 after Hertz); Dahl 1968 (with its exponent);
    Ikhouane and Rodellar 2007 (Bouc-Wen normalised to the yield force); Iwan 1966 (slip elements);
    Reynolds 1886 (viscosity falls exponentially with temperature); Blasius 1913 (exponent 1.75);
    Schiessel and Blumen 1993 (a fractional derivative as a ladder of relaxing branches).
"""

import math
from typing import NamedTuple

import numba
import numpy as np

CODES: dict[str, tuple[str, ...]] = {
    "none": (),
    "stiffness_error": ("stiffness_n_per_m",),
    "damping_error": ("damping_n_s_per_m",),
    "square_spring": ("stiffness_n_per_m2",),
    "cube_spring": ("stiffness_n_per_m3",),
    "power_spring": ("force_at_reach_n", "reach_m", "exponent"),
    "exponential_spring": ("force_n", "length_m"),
    "tangent_spring": ("force_n", "limit_m"),
    "gas_column": ("area_force_n", "column_m", "exponent", "charge_ratio"),
    "hertz_bumper": ("low_m", "high_m", "stiffness_n_per_m15", "dissipation_s_per_m"),
    "linear_bumper": ("low_m", "high_m", "stiffness_n_per_m", "damping_n_s_per_m"),
    "rubber_bumper": ("low_m", "high_m", "stiffness_n_per_m", "length_m"),
    "free_play": ("half_gap_m",),
    "soft_play": ("half_gap_m",),
    "bristle": ("coulomb_n", "breakaway_n", "stribeck_m_per_s", "bristle_m"),
    "stick": ("coulomb_n", "breakaway_n", "stribeck_m_per_s", "hyperbolic"),
    "orifice": ("force_at_1_m_per_s_n", "exponent"),
    "one_way": ("damping_n_s_per_m", "side"),
    "arctan_damper": ("force_n", "velocity_m_per_s"),
    "blow_off": ("damping_drop_n_s_per_m", "knee_m_per_s"),
    "mixed_damper": ("rebound_n", "knee_m_per_s", "compression_n_s2_per_m2"),
    "taper": ("damping_n_s_per_m2",),
    "groove": ("damping_n_s_per_m3",),
    "yielding": ("stiffness_n_per_m", "yield_n", "exponent", "softness"),
    "dahl": ("stiffness_n_per_m", "yield_n", "exponent"),
    "slip_elements": ("stiffness_n_per_m", "yield_n", "grading"),
    "relaxing_branch": ("stiffness_n_per_m", "relaxation_s"),
    "thin_oil": ("per_k", "heat_capacity_j_per_k", "cooling_s"),
    "time_fade": ("lost_fraction", "time_s", "stretch"),
    "work_fade": ("lost_fraction", "energy_j"),
    "hung_mass": ("mass_kg", "frequency_hz", "damping_ratio"),
    "cogging": ("force_n", "pitch_m", "phase_rad"),
    "ripple_damping": ("damping_n_s_per_m", "pitch_m", "phase_rad"),
    "fractional": ("coefficient_n", "order"),
    "gated_spring": ("stiffness_n_per_m",),
    "detent": ("force_n", "centre_m", "width_m"),
    "set_up_spring": ("force_n", "centre_m", "half_width_m"),
    "rigid_mass": ("mass_kg",),
    "accel_square": ("coefficient_n_s4_per_m2",),
}
"""Law -> parameters in order; the law's number is its position here."""

NUMBER = {name: number for number, name in enumerate(CODES)}
PARAMETERS_MAX = 4
SLIP_ELEMENTS = 8
LADDER = 14
LADDER_SLOWEST_RAD_PER_S = 0.05
LADDER_RATIO = 2.3
REFERENCE_C = 20.0

MEMORY = {
    "bristle": 1,
    "yielding": 1,
    "dahl": 1,
    "slip_elements": 2 * SLIP_ELEMENTS + 1,
    "relaxing_branch": 1,
    "thin_oil": 1,
    "work_fade": 1,
    "hung_mass": 2,
    "fractional": LADDER,
}
"""Law -> number of memory states; the others have none."""

(
    _NONE,
    _STIFFNESS,
    _DAMPING,
    _SQUARE,
    _CUBE,
    _POWER,
    _EXPONENTIAL,
    _TANGENT,
    _GAS,
    _HERTZ,
    _LINEAR_STOP,
    _RUBBER,
    _FREE_PLAY,
    _SOFT_PLAY,
    _BRISTLE,
    _STICK,
    _ORIFICE,
    _ONE_WAY,
    _ARCTAN,
    _BLOW_OFF,
    _MIXED,
    _TAPER,
    _GROOVE,
    _YIELDING,
    _DAHL,
    _SLIP_ELEMENTS,
    _RELAXING,
    _THIN_OIL,
    _TIME_FADE,
    _WORK_FADE,
    _HUNG_MASS,
    _COGGING,
    _RIPPLE,
    _FRACTIONAL,
    _GATED,
    _DETENT,
    _SET_UP,
    _RIGID_MASS,
    _ACCEL_SQUARE,
) = range(len(CODES))

(
    _IS_NONE,
    _IS_SPRING,
    _IS_CONTACT,
    _IS_PLAY,
    _IS_SPEED,
    _IS_PLACED,
    _IS_FADE,
    _IS_REMEMBERED,
) = range(8)

_KIND_OF = {
    _IS_SPRING: (_STIFFNESS, _SQUARE, _CUBE, _POWER, _EXPONENTIAL, _TANGENT, _GAS, _SET_UP),
    _IS_CONTACT: (_HERTZ, _LINEAR_STOP, _RUBBER),
    _IS_PLAY: (_FREE_PLAY, _SOFT_PLAY),
    _IS_SPEED: (_DAMPING, _ORIFICE, _ONE_WAY, _ARCTAN, _BLOW_OFF, _MIXED),
    _IS_PLACED: (_TAPER, _GROOVE, _COGGING, _RIPPLE, _GATED, _DETENT),
    _IS_FADE: (_THIN_OIL, _TIME_FADE, _WORK_FADE),
    _IS_REMEMBERED: (
        _BRISTLE,
        _YIELDING,
        _DAHL,
        _SLIP_ELEMENTS,
        _RELAXING,
        _HUNG_MASS,
        _FRACTIONAL,
    ),
}
# What acts through the mass or sticks, and what is a function of time, has no force here.
_KIND = np.zeros(len(CODES), dtype=np.int64)
for _kind, _codes in _KIND_OF.items():
    _KIND[list(_codes)] = _kind

STICK = _STICK


class Moment(NamedTuple):
    """Where the bench is at one time.

    Attributes:
        bench: (5,) mass, stiffness, damping, free length, gravity.
        t_s: Time.
        height_m: Height.
        velocity_m_per_s: Its rate.
        acceleration_m_per_s2: The rate's rate; a force may not depend on it.
        gate: Value of the bench's switching signal.
    """

    bench: np.ndarray
    t_s: float
    height_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    gate: float


@numba.njit(cache=True, error_model="numpy")
def _sign(value):
    return 1.0 if value > 0.0 else (-1.0 if value < 0.0 else 0.0)


@numba.njit(cache=True, error_model="numpy")
def _clip(value, limit):
    return max(-limit, min(limit, value))


@numba.njit(cache=True, error_model="numpy")
def sliding_friction_n(p, velocity):
    """Size of the sliding friction, falling from breakaway to Coulomb (Stribeck)."""
    # Only dry contact can be told to fall like a hyperbola; bristles are far shorter than 1 m.
    if p[3] == 1.0:
        return p[0] + (p[1] - p[0]) / (1.0 + abs(velocity) / p[2])
    return p[0] + (p[1] - p[0]) * math.exp(-((velocity / p[2]) ** 2))


@numba.njit(cache=True, error_model="numpy")
def _bristle_rate(p, v, deflection):
    stiffness = p[0] / p[3]
    return v - stiffness * abs(v) / sliding_friction_n(p, v) * deflection


@numba.njit(cache=True, error_model="numpy")
def _bristle_force(p, v, deflection):
    # Micro-damping fades with speed, else the bristles act like a viscous damper.
    stiffness = p[0] / p[3]
    micro = 0.002 * stiffness * math.exp(-((v / p[2]) ** 2))
    return -(stiffness * deflection + micro * _bristle_rate(p, v, deflection))


@numba.njit(cache=True, error_model="numpy")
def _push(code, p, depth, speed_in):
    if code == _HERTZ:
        return max(0.0, p[2] * depth * math.sqrt(depth) * (1.0 + 1.5 * p[3] * speed_in))
    if code == _RUBBER:
        # Rubber gives back less than it took.
        lost = 0.85 if speed_in < 0.0 else 1.0
        return lost * p[2] * p[3] * math.expm1(depth / p[3])
    return max(0.0, p[2] * depth + p[3] * speed_in)


@numba.njit(cache=True, error_model="numpy")
def _contact_force(code, p, z, v):
    force = 0.0
    depth = p[0] - z
    if depth > 0.0:
        force += _push(code, p, depth, -v)
    depth = z - p[1]
    if depth > 0.0:
        force -= _push(code, p, depth, v)
    return force


@numba.njit(cache=True, error_model="numpy")
def _stiffening_force(code, p, x):
    """Springs with a limit or a growth of their own."""
    if code == _SET_UP:
        return -p[0] * _clip((x - p[1]) / p[2], 1.0)
    if code == _EXPONENTIAL:
        return p[0] * math.expm1(-x / p[1])
    if code == _TANGENT:
        u = 0.5 * math.pi * max(-0.98, min(0.98, x / p[1]))
        return -p[0] * (math.tan(u) - u)
    # Gas column against the atmosphere: absolute pressure over atmospheric is charge_ratio at
    # the free length, and area_force is the atmosphere's pressure times the area.
    return p[0] * (p[3] * (p[1] / (p[1] + x)) ** p[2] - 1.0)


@numba.njit(cache=True, error_model="numpy")
def _spring_force(code, p, x):
    if code == _STIFFNESS:
        return -p[0] * x
    if code == _SQUARE:
        return -p[0] * x * x
    if code == _CUBE:
        return -p[0] * x * x * x
    if code == _POWER:
        return -p[0] * _sign(x) * (abs(x) / p[1]) ** p[2]
    return _stiffening_force(code, p, x)


@numba.njit(cache=True, error_model="numpy")
def _speed_force(code, p, v):
    """Dampers whose force depends on velocity alone."""
    if code == _DAMPING:
        return -p[0] * v
    if code == _ORIFICE:
        return -p[0] * _sign(v) * abs(v) ** p[1]
    if code == _ONE_WAY:
        return -p[0] * v if v * p[1] > 0.0 else 0.0
    if code == _ARCTAN:
        return -p[0] * (2.0 / math.pi) * math.atan(v / p[1])
    if code == _MIXED:
        # Rebound blows off, compression grows with the square.
        return -p[0] * math.tanh(v / p[1]) if v > 0.0 else p[2] * v * v
    return p[0] * _sign(v) * max(0.0, abs(v) - p[1])


@numba.njit(cache=True, error_model="numpy")
def _slack(code, p, x):
    """Part of the deflection that the spring does not feel."""
    return p[0] * math.tanh(x / p[0]) if code == _SOFT_PLAY else _clip(x, p[0])


@numba.njit(cache=True, error_model="numpy")
def _placed_force(code, p, x, v, gate):
    """What depends on where the strut stands in a way that is neither spring nor stop."""
    if code == _TAPER:
        return -p[0] * max(0.0, -x) * v
    if code == _GROOVE:
        return -p[0] * x * x * v
    if code == _COGGING:
        return p[0] * math.sin(2.0 * math.pi * x / p[1] + p[2])
    if code == _RIPPLE:
        return -p[0] * (1.0 + math.sin(2.0 * math.pi * x / p[1] + p[2])) * v
    if code == _GATED:
        return -p[0] * gate * x
    u = (x - p[1]) / p[2]
    return -p[0] * u * math.exp(0.5 - 0.5 * u * u)


@numba.njit(cache=True, error_model="numpy")
def kept_damping(code, p, t, memory):
    """Fraction of the damping that a fading damper still has."""
    if code == _THIN_OIL:
        return math.exp(-p[0] * (memory[0] + memory[-1] - REFERENCE_C))
    if code == _TIME_FADE:
        return 1.0 - p[0] * (1.0 - math.exp(-((t / p[1]) ** p[2])))
    return 1.0 - p[0] * (1.0 - math.exp(-memory[0] / p[1]))


@numba.njit(cache=True, error_model="numpy")
def _element_force(p, i, moved, memory):
    # Between two steps the body moves one way, so the elements are exact, not integrated.
    limit = p[1] * memory[SLIP_ELEMENTS + 1 + i]
    return _clip(memory[i] + p[0] / SLIP_ELEMENTS * moved, limit)


@numba.njit(cache=True, error_model="numpy")
def _slip_force(p, z, memory):
    total = 0.0
    for i in range(SLIP_ELEMENTS):
        total += _element_force(p, i, z - memory[SLIP_ELEMENTS], memory)
    return -total


@numba.njit(cache=True, error_model="numpy")
def settle_slip_elements(p, z, memory):
    """End of a step: keep each element's force and where it was left."""
    for i in range(SLIP_ELEMENTS):
        memory[i] = _element_force(p, i, z - memory[SLIP_ELEMENTS], memory)
    memory[SLIP_ELEMENTS] = z


@numba.njit(cache=True, error_model="numpy")
def _hung_force(p, memory, gravity):
    # Memory: how far the hung mass stands above where it hangs at rest, and its velocity.
    omega = 2.0 * math.pi * p[1]
    return p[0] * (omega * omega * memory[0] + 2.0 * p[2] * omega * memory[1] - gravity)


@numba.njit(cache=True, error_model="numpy")
def _ladder_force(p, memory):
    total = 0.0
    for i in range(LADDER):
        total += memory[i]
    return -p[0] * total


@numba.njit(cache=True, error_model="numpy")
def _remembered_force(code, p, moment, memory):
    """Forces that depend on what happened before."""
    if code == _BRISTLE:
        return _bristle_force(p, moment.velocity_m_per_s, memory[0])
    if code == _SLIP_ELEMENTS:
        return _slip_force(p, moment.height_m, memory)
    if code == _RELAXING:
        return -p[0] * memory[0]
    if code == _HUNG_MASS:
        return _hung_force(p, memory, moment.bench[4])
    if code == _FRACTIONAL:
        return _ladder_force(p, memory)
    return -memory[0]


@numba.njit(cache=True, error_model="numpy")
def force_n(code, p, moment, memory):
    """Force of one law.

    Args:
        code: Number of the law.
        p: Its parameters.
        moment: Where the bench is.
        memory: Its memory states, and a last entry that holds the ambient temperature in °C.
    """
    x, v = moment.height_m - moment.bench[3], moment.velocity_m_per_s
    kind = _KIND[code]
    force = 0.0
    if kind == _IS_SPRING:
        force = _spring_force(code, p, x)
    elif kind == _IS_CONTACT:
        force = _contact_force(code, p, moment.height_m, v)
    elif kind == _IS_PLAY:
        force = moment.bench[1] * _slack(code, p, x)
    elif kind == _IS_SPEED:
        force = _speed_force(code, p, v)
    elif kind == _IS_PLACED:
        force = _placed_force(code, p, x, v, moment.gate)
    elif kind == _IS_FADE:
        force = moment.bench[2] * (1.0 - kept_damping(code, p, moment.t_s, memory)) * v
    elif kind == _IS_REMEMBERED:
        force = _remembered_force(code, p, moment, memory)
    return force


@numba.njit(cache=True, error_model="numpy")
def _yielding_rate(p, v, force):
    # Bouc-Wen in units of force: it yields at p[1] and unloads with a stiffness set by p[3].
    load = force / p[1]
    shape = p[3] + (1.0 - p[3]) * _sign(v * load)
    return p[0] * v * (1.0 - abs(load) ** p[2] * shape)


@numba.njit(cache=True, error_model="numpy")
def _dahl_rate(p, v, force):
    rest = 1.0 - force / p[1] * _sign(v)
    return p[0] * v * _sign(rest) * abs(rest) ** p[2]


@numba.njit(cache=True, error_model="numpy")
def _hung_rate(p, acceleration, memory, out):
    omega = 2.0 * math.pi * p[1]
    out[0] = memory[1]
    out[1] = -omega * omega * memory[0] - 2.0 * p[2] * omega * memory[1] - acceleration


@numba.njit(cache=True, error_model="numpy")
def _ladder_rate(p, v, memory, out):
    corner = LADDER_SLOWEST_RAD_PER_S
    for i in range(LADDER):
        out[i] = corner ** p[1] * v - corner * memory[i]
        corner *= LADDER_RATIO


@numba.njit(cache=True, error_model="numpy")
def memory_rate(code, p, moment, memory, out):
    """Write the time derivative of a law's memory into `out`, which holds zeros."""
    v = moment.velocity_m_per_s
    if code == _BRISTLE:
        out[0] = _bristle_rate(p, v, memory[0])
    elif code == _YIELDING:
        out[0] = _yielding_rate(p, v, memory[0])
    elif code == _DAHL:
        out[0] = _dahl_rate(p, v, memory[0])
    elif code == _RELAXING:
        out[0] = v - memory[0] / p[1]
    elif code in (_THIN_OIL, _WORK_FADE):
        power = moment.bench[2] * kept_damping(code, p, moment.t_s, memory) * v * v
        out[0] = power / p[1] - memory[0] / p[2] if code == _THIN_OIL else power
    elif code == _HUNG_MASS:
        _hung_rate(p, moment.acceleration_m_per_s2, memory, out)
    elif code == _FRACTIONAL:
        _ladder_rate(p, v, memory, out)


class System(NamedTuple):
    """What stays the same during a run, as the compiled code wants it.

    Attributes:
        bench: (5,) mass, stiffness, damping, free length, gravity.
        codes: (effects,) number of each law.
        parameters: (effects, 4) its parameters.
        at: (effects + 1,) where its memory begins in the state.
        extra_mass_kg: Mass that the model does not know of.
        quadratic: Coefficient of a force against the squared acceleration.
        stick: Which effect is dry contact, or -1.
        drive_n: (2 n + 1,) forces that depend on time alone, at steps and half steps.
        gate: (2 n + 1,) the switching signal, likewise.
        step_s: Length of a step.
    """

    bench: np.ndarray
    codes: np.ndarray
    parameters: np.ndarray
    at: np.ndarray
    extra_mass_kg: float
    quadratic: float
    stick: int
    drive_n: np.ndarray
    gate: np.ndarray
    step_s: float


@numba.njit(cache=True, error_model="numpy")
def _acceleration(force, mass, quadratic):
    # mass * a + quadratic * a |a| = force, solved for a.
    if quadratic == 0.0:
        return force / mass
    size = (math.sqrt(mass * mass + 4.0 * quadratic * abs(force)) - mass) / (2.0 * quadratic)
    return size if force > 0.0 else -size


@numba.njit(cache=True, error_model="numpy")
def _derivative(system, half, y, held_n, out):
    """Rates of `y` at a half step; returns the force on the body without what holds it."""
    bench, at = system.bench, system.at
    z, v = y[0], y[1]
    mass = bench[0] + system.extra_mass_kg
    t, gate = 0.5 * half * system.step_s, system.gate[half]
    others = system.drive_n[half] - bench[1] * (z - bench[3]) - bench[2] * v - mass * bench[4]
    still = Moment(bench, t, z, v, 0.0, gate)
    for e in range(system.codes.size):
        memory = y[at[e] : at[e + 1]]
        others += force_n(system.codes[e], system.parameters[e], still, memory)
    a = _acceleration(others + held_n, mass, system.quadratic)
    for i in range(out.size):
        out[i] = 0.0
    out[0], out[1] = v, a
    moment = Moment(bench, t, z, v, a, gate)
    for e in range(system.codes.size):
        memory, rate = y[at[e] : at[e + 1]], out[at[e] : at[e + 1]]
        memory_rate(system.codes[e], system.parameters[e], moment, memory, rate)
    return others


@numba.njit(cache=True, error_model="numpy")
def _sliding_n(system, slip, v):
    """Friction of a dry surface that slides towards `slip`; none if there is none."""
    if slip == 0.0:
        return 0.0
    return -slip * sliding_friction_n(system.parameters[system.stick], v)


@numba.njit(cache=True, error_model="numpy")
def _runge_kutta(system, k, slip, y, work):
    """One step of `y` in place."""
    h = system.step_s
    trial = work[4]
    for stage in range(4):
        ahead = (stage + 1) // 2
        for i in range(y.size):
            trial[i] = y[i] + (0.5 * ahead * h * work[stage - 1, i] if stage > 0 else 0.0)
        held = _sliding_n(system, slip, trial[1])
        _derivative(system, 2 * k + ahead, trial, held, work[stage])
    for i in range(y.size):
        y[i] += h / 6.0 * (work[0, i] + 2.0 * (work[1, i] + work[2, i]) + work[3, i])


@numba.njit(cache=True, error_model="numpy")
def _stuck_step(system, k, others_n, y, work):
    # The body stands still; what has a memory goes on. Euler is exact enough: nothing moves.
    z = y[0]
    _derivative(system, 2 * k, y, -others_n, work[0])
    for i in range(y.size):
        y[i] += system.step_s * work[0, i]
    y[0], y[1] = z, 0.0


@numba.njit(cache=True, error_model="numpy")
def _slip_direction(y, others_n, parameters):
    """Direction in which a dry surface slides during the next step; 0 if it sticks."""
    if y[1] != 0.0:
        return 1.0 if y[1] > 0.0 else -1.0
    if abs(others_n) <= parameters[1]:
        return 0.0
    return 1.0 if others_n > 0.0 else -1.0


@numba.njit(cache=True, error_model="numpy")
def _turn(system, k, z, v, y, work):
    """End of a step, from `z` and `v`, in which a sliding body stops: it may stick or turn round.

    Friction changes sign where the body stands still, not at the end of the step.
    """
    h, a = system.step_s, work[0, 1]
    bend = (y[1] - v - a * h) / (h * h)
    t = h * v / (v - y[1])
    for _ in range(3):
        slope = a + 2.0 * bend * t
        if slope != 0.0:
            t = min(max(t - (v + t * (a + t * bend)) / slope, 0.0), h)
    y[0], y[1] = z + t * (v + t * (0.5 * a + t * bend / 3.0)), 0.0
    others = _derivative(system, 2 * k + 2, y, 0.0, work[0])
    slip = _slip_direction(y, others, system.parameters[system.stick])
    if slip != 0.0:
        mass = system.bench[0] + system.extra_mass_kg
        back = _acceleration(others + _sliding_n(system, slip, 0.0), mass, system.quadratic)
        y[0], y[1] = y[0] + 0.5 * back * (h - t) ** 2, back * (h - t)


@numba.njit(cache=True, error_model="numpy")
def _advance(system, k, y, work):
    """One step of `y` in place."""
    slip = 0.0
    if system.stick >= 0:
        others = _derivative(system, 2 * k, y, 0.0, work[0])
        slip = _slip_direction(y, others, system.parameters[system.stick])
        if slip == 0.0:
            _stuck_step(system, k, others, y, work)
            return
    z, v = y[0], y[1]
    _runge_kutta(system, k, slip, y, work)
    if slip * y[1] < 0.0:
        _turn(system, k, z, v, y, work)
    for e in range(system.codes.size):
        if system.codes[e] == _SLIP_ELEMENTS:
            memory = y[system.at[e] : system.at[e + 1]]
            settle_slip_elements(system.parameters[e], y[0], memory)


@numba.njit(cache=True, error_model="numpy")
def _observe(system, half, y, forces, work):
    """Write the effects' forces at a sample; returns the body's acceleration."""
    held = 0.0
    others = _derivative(system, half, y, 0.0, work)
    if system.stick >= 0:
        slip = _slip_direction(y, others, system.parameters[system.stick])
        held = -others if slip == 0.0 else _sliding_n(system, slip, y[1])
        _derivative(system, half, y, held, work)
    a = work[1]
    t = 0.5 * half * system.step_s
    moment = Moment(system.bench, t, y[0], y[1], a, system.gate[half])
    for e in range(system.codes.size):
        code, memory = system.codes[e], y[system.at[e] : system.at[e + 1]]
        forces[e] = force_n(code, system.parameters[e], moment, memory)
        if code == _STICK:
            forces[e] = held
        elif code == _RIGID_MASS:
            forces[e] = -system.extra_mass_kg * (a + system.bench[4])
        elif code == _ACCEL_SQUARE:
            forces[e] = -system.quadratic * a * abs(a)
    return a


@numba.njit(cache=True, error_model="numpy")
def run(system, steps, y):
    """Integrate to the end of the drive.

    Args:
        system: The bench.
        steps: Steps between two samples.
        y: Initial state; overwritten.

    Returns:
        (n, states) states, (n,) accelerations and (n, effects) forces at the samples.
    """
    samples = (system.drive_n.size - 1) // (2 * steps) + 1
    states = np.empty((samples, y.size))
    accelerations = np.empty(samples)
    forces = np.empty((samples, system.codes.size))
    work = np.zeros((5, y.size))
    for i in range(samples):
        states[i] = y
        accelerations[i] = _observe(system, 2 * i * steps, y, forces[i], work[0])
        if i < samples - 1:
            for s in range(steps):
                _advance(system, i * steps + s, y, work)
    return states, accelerations, forces


@numba.njit(cache=True, error_model="numpy")
def _moment_on(system, path, half):
    t = 0.5 * half * system.step_s
    z, v, a = path[0, half], path[1, half], path[2, half]
    return Moment(system.bench, t, z, v, a, system.gate[half])


@numba.njit(cache=True, error_model="numpy")
def _path_rates(system, path, half, y, out):
    """Rates of all memories at a half step of an prescribed motion."""
    moment, at = _moment_on(system, path, half), system.at
    for i in range(out.size):
        out[i] = 0.0
    for e in range(system.codes.size):
        memory, rate = y[at[e] : at[e + 1]], out[at[e] : at[e + 1]]
        memory_rate(system.codes[e], system.parameters[e], moment, memory, rate)


@numba.njit(cache=True, error_model="numpy")
def _advance_on(system, path, k, y, work):
    """One step of all memories in place, the motion being prescribed."""
    h = system.step_s
    trial = work[4]
    for stage in range(4):
        ahead = (stage + 1) // 2
        for i in range(y.size):
            trial[i] = y[i] + (0.5 * ahead * h * work[stage - 1, i] if stage > 0 else 0.0)
        _path_rates(system, path, 2 * k + ahead, trial, work[stage])
    for i in range(y.size):
        y[i] += h / 6.0 * (work[0, i] + 2.0 * (work[1, i] + work[2, i]) + work[3, i])
    for e in range(system.codes.size):
        if system.codes[e] == _SLIP_ELEMENTS:
            memory = y[system.at[e] : system.at[e + 1]]
            settle_slip_elements(system.parameters[e], path[0, 2 * k + 2], memory)


@numba.njit(cache=True, error_model="numpy")
def _observe_on(system, path, half, y, forces):
    moment = _moment_on(system, path, half)
    for e in range(system.codes.size):
        code, p = system.codes[e], system.parameters[e]
        if code == _STICK:
            v = moment.velocity_m_per_s
            forces[e] = -_sign(v) * sliding_friction_n(p, v)
        else:
            forces[e] = force_n(code, p, moment, y[system.at[e] : system.at[e + 1]])


@numba.njit(cache=True, error_model="numpy")
def run_along(system, path, steps, y):
    """Follow all memories along an prescribed motion; what acts through a mass gives no force.

    Args:
        system: The bench; its drive is not read.
        path: (3, 2 n + 1) height, velocity and acceleration at steps and half steps.
        steps: Steps between two samples.
        y: Initial memories; overwritten.

    Returns:
        (n, memories) memories and (n, effects) forces at the samples.
    """
    samples = (path.shape[1] - 1) // (2 * steps) + 1
    memories = np.empty((samples, y.size))
    forces = np.empty((samples, system.codes.size))
    work = np.zeros((5, y.size))
    for i in range(samples):
        memories[i] = y
        _observe_on(system, path, 2 * i * steps, y, forces[i])
        if i < samples - 1:
            for s in range(steps):
                _advance_on(system, path, i * steps + s, y, work)
    return memories, forces


def slip_memory(truth: dict[str, float], height_m: float) -> np.ndarray:
    """First memory of slip elements: no force, where the body stands, shares of the yield force."""
    shares = np.arange(1.0, SLIP_ELEMENTS + 1.0) ** truth["grading"]
    return np.concatenate([np.zeros(SLIP_ELEMENTS), [height_m], shares / shares.sum()])


def parameter_row(law: str, truth: dict[str, float]) -> np.ndarray:
    """Parameters of a law as the row that the compiled laws read."""
    row = np.zeros(PARAMETERS_MAX)
    names = CODES[law]
    row[: len(names)] = [truth[name] for name in names]
    return row
