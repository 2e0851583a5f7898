"""Equations of motion of the bench, and the integrator.

Bodies move along the vertical axis. Strut i carries body i (bodies are ordered so) and stands on
the world or on an earlier body. The state of all is one vector:

    positions (n), velocities (n), temperature (1), internal states of the effects (any number)

Everything here is compiled by numba and lies in one file, because numba's cache on disk notices a
change only in the file of the function that was cached. No law is shared with any other package.

References:
    Canudas de Wit, Olsson, Astrom, Lischinsky, "A new model for control of systems with friction",
    IEEE TAC 40 (1995): friction as a bristle.
    Hunt, Crossley, "Coefficient of restitution interpreted as damping in vibroimpact", J. Appl.
    Mech. 42 (1975): stops.
    Ikhouane, Rodellar, "Systems with Hysteresis" (2007): Bouc-Wen.
    Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I" (1993): Runge-Kutta.
"""

import math
from collections.abc import Callable
from enum import IntEnum, unique
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_P = ParamSpec("_P")
_R = TypeVar("_R")


@unique
class Law(IntEnum):
    """codes of the laws in the compiled equations of motion."""

    PRELOAD = 0
    LINEAR_STIFFNESS = 1
    QUADRATIC_STIFFNESS = 2
    CUBIC_STIFFNESS = 3
    PROGRESSIVE_STIFFNESS = 4
    GAS_SPRING = 5
    BUMP_STOP = 6
    REBOUND_STOP = 7
    BACKLASH = 8
    LINEAR_DAMPING = 9
    QUADRATIC_DAMPING = 10
    ASYMMETRIC_DAMPING = 11
    DIGRESSIVE_DAMPING = 12
    POSITION_DEPENDENT_DAMPING = 13
    FRICTION = 14
    BOUC_WEN = 15
    MAXWELL = 16
    PERIODIC_FORCE = 17
    TEMPERATURE_FADE = 18
    TIME_FADE = 19
    HIDDEN_MASS = 20
    ADDED_MASS = 21
    INPUT_GAIN = 22
    DELAY = 23


LAW, STRUT, STATE = 0, 1, 2
"""Columns of `Effects.places`."""
SINE_COLUMNS = 3
"""amplitude_n, rate_rad_per_s, phase_rad."""
SWEEP_COLUMNS = 5
"""amplitude_n, start_hz, end_hz, duration_s, 1 if the spacing is logarithmic else 0."""
GIVEN = 3
"""What the drive gives at a time: force on the driven body, prescribed height, its rate."""
RECORD_COLUMNS = 3
"""Columns of a record for each strut: height, rate of height, strut force."""
RECORD_EXTRA = 3
"""Columns of a record after those of the struts: applied force, acting force, temperature."""


class Curves(NamedTuple):
    """Piecewise cubic curves, one a strut, straight beyond their ends.

    Attributes:
        first: First segment of each curve, and one past the last, shape (struts + 1,).
        segments: Start and length of each segment, and its coefficients from the cube down to the
            constant, shape (segments, 6).
    """

    first: Integers
    segments: Floats


class Applied(NamedTuple):
    """The applied force.

    Attributes:
        gain: Undeclared factor between the force applied and the force that acts.
        delay_s: Undeclared delay between them.
        sines: Shape (sines, 3), see `SINE_COLUMNS`.
        sweeps: Shape (sweeps, 5), see `SWEEP_COLUMNS`.
        file_first: First sample of each file, and one past the last, shape (files + 1,).
        file_t_s: Times of all files, shape (samples,).
        file_force_n: Forces of all files, shape (samples,).
    """

    gain: float
    delay_s: float
    sines: Floats
    sweeps: Floats
    file_first: Integers
    file_t_s: Floats
    file_force_n: Floats


class Prescribed(NamedTuple):
    """The motion prescribed on a strut.

    Attributes:
        mean_height_m: Height about which it moves.
        sines: Shape (sines, 3), see `SINE_COLUMNS`, in m.
        sweeps: Shape (sweeps, 5), see `SWEEP_COLUMNS`, in m.
        files: Heights over time, as curves.
    """

    mean_height_m: float
    sines: Floats
    sweeps: Floats
    files: Curves


class Drive(NamedTuple):
    """What drives the bench.

    Attributes:
        force: The applied force.
        prescribed: The prescribed motion; not looked at where no strut's motion is prescribed.
    """

    force: Applied
    prescribed: Prescribed


class Effects(NamedTuple):
    """The undeclared effects that are laws of force.

    Attributes:
        places: Code of each law, its strut, and the index of its first internal state in the state
            vector, shape (effects, 3).
        parameters: Values in the order of `rig.simulated_bench.effects`, shape (effects,
            PARAMETER_COUNT).
    """

    places: Integers
    parameters: Floats


class Thermal(NamedTuple):
    """The damper's temperature.

    Attributes:
        warming_k_per_j: Reciprocal of the heat capacity.
        cooling_per_s: Reciprocal of the time constant of cooling.
        ambient_c: Temperature of the air.
    """

    warming_k_per_j: float
    cooling_per_s: float
    ambient_c: float


class Mechanics(NamedTuple):
    """The bench as the equations of motion see it.

    Few arrays, because compiled code counts references to each of them on every call.

    Attributes:
        gravity_m_per_s2: Acceleration of free fall.
        mass_kg: Mass of each body, shape (n,).
        lower: Body on which each strut stands, -1 for the world, shape (n,).
        driven: Body on which the applied force acts.
        prescribed: Strut whose motion is prescribed, -1 if there is none.
        free_length_m: Free length of each strut, shape (n,).
        springs: Spring curves over height.
        dampers: Damper curves over rate of height.
        effects: Undeclared effects.
        thermal: The damper's temperature.
    """

    gravity_m_per_s2: float
    mass_kg: Floats
    lower: Integers
    driven: int
    prescribed: int
    free_length_m: Floats
    springs: Curves
    dampers: Curves
    effects: Effects
    thermal: Thermal


class Step(NamedTuple):
    """One step of the integrator.

    Attributes:
        t_s: Time at its start in s.
        length_s: Length in s.
    """

    t_s: float
    length_s: float


class Span(NamedTuple):
    """A row of records.

    Attributes:
        first: Number of the first record; record k is at `k * substeps * step_s`.
        substeps: Steps of the integrator between records.
        step_s: Length of a step in s.
    """

    first: int
    substeps: int
    step_s: float


def _compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function to machine code, typed as it was."""
    compiler = cast("Any", numba).njit(cache=True, error_model="numpy")
    return cast("Callable[_P, _R]", compiler(function))


@_compiled
def curve_segment(curves: Curves, curve: int, at: float) -> int:
    """Segment of a curve at, or nearest to, a place on it."""
    low = int(curves.first[curve])
    high = int(curves.first[curve + 1]) - 1
    while low < high:
        middle = (low + high + 1) // 2
        if curves.segments[middle, 0] <= at:
            low = middle
        else:
            high = middle - 1
    return low


@_compiled
def curve_force(curves: Curves, strut: int, at: float) -> float:
    """Force of a curve in N at a height in m or a rate in m/s."""
    segments = curves.segments
    low = curve_segment(curves, strut, at)
    offset = at - segments[low, 0]
    inside = min(max(offset, 0.0), segments[low, 1])
    a = segments[low, 2]
    b = segments[low, 3]
    c = segments[low, 4]
    force_n = ((a * inside + b) * inside + c) * inside + segments[low, 5]
    slope = (3.0 * a * inside + 2.0 * b) * inside + c
    return force_n + slope * (offset - inside)


@_compiled
def applied_force(drive: Applied, t_s: float) -> float:
    """Applied force in N at a time, zero before time zero."""
    if t_s < 0.0:
        return 0.0
    force_n = 0.0
    for i in range(drive.sines.shape[0]):
        force_n += drive.sines[i, 0] * math.sin(drive.sines[i, 1] * t_s + drive.sines[i, 2])
    for i in range(drive.sweeps.shape[0]):
        force_n += _sweep(drive.sweeps[i], t_s)
    for i in range(drive.file_first.shape[0] - 1):
        force_n += _interpolated(drive, drive.file_first[i], drive.file_first[i + 1] - 1, t_s)
    return force_n


@_compiled
def _sweep(sweep: Floats, t_s: float) -> float:
    if t_s > sweep[3]:
        return 0.0
    return float(sweep[0]) * math.sin(2.0 * math.pi * _sweep_turns(sweep, t_s)[0])


@_compiled
def _sweep_turns(sweep: Floats, t_s: float) -> tuple[float, float]:
    """Turns since the start, and frequency in Hz."""
    _, start_hz, end_hz, duration_s, logarithmic = sweep
    if logarithmic > 0.0 and start_hz != end_hz:
        growth = math.log(end_hz / start_hz) / duration_s
        turns = start_hz * math.expm1(growth * t_s) / growth
        return turns, start_hz * math.exp(growth * t_s)
    rise = (end_hz - start_hz) * t_s / duration_s
    return (start_hz + 0.5 * rise) * t_s, start_hz + rise


@_compiled
def _interpolated(drive: Applied, low: int, high: int, t_s: float) -> float:
    t = drive.file_t_s
    force_n = drive.file_force_n
    if t_s < t[low] or t_s > t[high]:
        return 0.0
    while high - low > 1:
        middle = (low + high) // 2
        if t[middle] <= t_s:
            low = middle
        else:
            high = middle
    share = (t_s - t[low]) / (t[high] - t[low])
    return force_n[low] + share * (force_n[high] - force_n[low])


@_compiled
def acting_force(drive: Applied, t_s: float) -> float:
    """Force in N that reaches the driven body, after undeclared gain and delay."""
    return drive.gain * applied_force(drive, t_s - drive.delay_s)


@_compiled
def prescribed_motion(prescribed: Prescribed, t_s: float) -> tuple[float, float]:
    """Prescribed height in m and its rate in m/s. Files and sweeps stay where they end."""
    height_m = prescribed.mean_height_m
    rate_m_per_s = 0.0
    for i in range(prescribed.sines.shape[0]):
        rate_rad_per_s = prescribed.sines[i, 1]
        phase = rate_rad_per_s * t_s + prescribed.sines[i, 2]
        height_m += prescribed.sines[i, 0] * math.sin(phase)
        rate_m_per_s += prescribed.sines[i, 0] * rate_rad_per_s * math.cos(phase)
    for i in range(prescribed.sweeps.shape[0]):
        amplitude_m = prescribed.sweeps[i, 0]
        end_s = prescribed.sweeps[i, 3]
        turns, frequency_hz = _sweep_turns(prescribed.sweeps[i], min(t_s, end_s))
        height_m += amplitude_m * math.sin(2.0 * math.pi * turns)
        if t_s < end_s:
            phase = 2.0 * math.pi * turns
            rate_m_per_s += amplitude_m * 2.0 * math.pi * frequency_hz * math.cos(phase)
    for i in range(prescribed.files.first.shape[0] - 1):
        segment = prescribed.files.segments[curve_segment(prescribed.files, i, t_s)]
        start, length, a, b, c, d = segment
        offset = min(max(t_s - start, 0.0), length)
        height_m += ((a * offset + b) * offset + c) * offset + d
        if offset == t_s - start:
            rate_m_per_s += (3.0 * a * offset + 2.0 * b) * offset + c
    return height_m, rate_m_per_s


@_compiled
def give(mechanics: Mechanics, drive: Drive, t_s: float, given: Floats) -> None:
    """Write what the drive gives at a time, shape (GIVEN,)."""
    given[0] = acting_force(drive.force, t_s)
    if mechanics.prescribed >= 0:
        given[1], given[2] = prescribed_motion(drive.prescribed, t_s)


@_compiled
def prescribe(mechanics: Mechanics, given: Floats, y: Floats) -> None:
    """Put the body above an prescribed strut where the drive has it."""
    body = mechanics.prescribed
    if body < 0:
        return
    n = mechanics.mass_kg.shape[0]
    below = int(mechanics.lower[body])
    y[body] = given[1] + (y[below] if below >= 0 else 0.0)
    y[n + body] = given[2] + (y[n + below] if below >= 0 else 0.0)


@_compiled
def spring_effect(law: int, p: Floats, deflection_m: float) -> float:
    """Force in N of an effect that depends on the deflection from the free length."""
    if law == Law.PRELOAD:
        return p[0]
    if law == Law.LINEAR_STIFFNESS:
        return -p[0] * deflection_m
    if law == Law.QUADRATIC_STIFFNESS:
        return -p[0] * deflection_m**2
    if law == Law.CUBIC_STIFFNESS:
        return -p[0] * deflection_m**3
    if law == Law.PROGRESSIVE_STIFFNESS:
        ratio = deflection_m / p[1]
        return -p[0] * (math.sinh(ratio) - ratio)
    gas_length_m = max(p[1] + deflection_m, 0.01 * p[1])
    return p[0] * (p[1] / gas_length_m) ** p[2]


@_compiled
def contact_effect(law: int, p: Floats, height_m: float, velocity_m_per_s: float) -> float:
    """Force in N of a stop, which never pulls, or of a link with free play."""
    if law == Law.BACKLASH:
        off_centre_m = height_m - p[0]
        beyond_m = max(abs(off_centre_m) - 0.5 * p[1], 0.0)
        return -p[2] * math.copysign(beyond_m, off_centre_m)
    outwards = 1.0 if law == Law.BUMP_STOP else -1.0
    depth_m = outwards * (p[0] - height_m)
    if depth_m <= 0.0:
        return 0.0
    closing_m_per_s = -outwards * velocity_m_per_s
    force_n = p[1] * depth_m**1.5 * (1.0 + p[2] * closing_m_per_s)
    return outwards * max(force_n, 0.0)


@_compiled
def damping_effect(law: int, p: Floats, deflection_m: float, velocity_m_per_s: float) -> float:
    """Force in N of an effect that opposes the rate of height."""
    if law == Law.LINEAR_DAMPING:
        return -p[0] * velocity_m_per_s
    if law == Law.QUADRATIC_DAMPING:
        return -p[0] * abs(velocity_m_per_s) * velocity_m_per_s
    if law == Law.ASYMMETRIC_DAMPING:
        return -(p[1] if velocity_m_per_s > 0.0 else p[0]) * velocity_m_per_s
    if law == Law.DIGRESSIVE_DAMPING:
        return -p[0] * velocity_m_per_s / math.sqrt(1.0 + (velocity_m_per_s / p[1]) ** 2)
    return -p[0] * (deflection_m / p[1]) ** 2 * velocity_m_per_s


@_compiled
def memory_rate(law: int, p: Floats, velocity_m_per_s: float, state: float) -> float:
    """Rate of the internal state of an effect with memory.

    The state is the bristle's deflection in m (friction), the elastic deflection in m (Bouc-Wen) or
    the force in N (Maxwell).
    """
    if law == Law.FRICTION:
        ratio = velocity_m_per_s / p[3]
        level = 1.0 + (p[2] - 1.0) * math.exp(-ratio * ratio)
        return velocity_m_per_s - abs(velocity_m_per_s) * state / (p[1] * level)
    if law == Law.BOUC_WEN:
        ratio = abs(state / p[1]) ** p[2]
        same_way = 1.0 if velocity_m_per_s * state > 0.0 else -1.0
        return velocity_m_per_s * (1.0 - ratio * (p[3] * same_way + 1.0 - p[3]))
    return p[0] * velocity_m_per_s - state / p[1]


@_compiled
def memory_effect(law: int, p: Floats, state: float, state_rate: float) -> float:
    """Force in N of an effect with memory, from its internal state and the state's rate."""
    if law == Law.FRICTION:
        return -(p[0] / p[1] * state + p[4] * state_rate)
    if law == Law.BOUC_WEN:
        return -p[0] * state
    return -state


@_compiled
def fade_factor(effects: Effects, strut: int, t_s: float, temperature_c: float) -> float:
    """Factor on the damper curve of a strut from all its fades."""
    factor = 1.0
    for i in range(effects.places.shape[0]):
        if effects.places[i, STRUT] != strut:
            continue
        p = effects.parameters[i]
        if effects.places[i, LAW] == Law.TEMPERATURE_FADE:
            factor *= math.exp(-p[0] * (temperature_c - p[1]))
        elif effects.places[i, LAW] == Law.TIME_FADE:
            factor *= p[0] + (1.0 - p[0]) * math.exp(-t_s / p[1])
    return factor


@_compiled
def strut_height(lower: Integers, strut: int, y: Floats) -> float:
    """Height of a strut in m."""
    below = int(lower[strut])
    return float(y[strut]) - (float(y[below]) if below >= 0 else 0.0)


@_compiled
def strut_rate(lower: Integers, strut: int, y: Floats) -> float:
    """Rate of height of a strut in m/s."""
    n = lower.shape[0]
    below = int(lower[strut])
    return float(y[n + strut]) - (float(y[n + below]) if below >= 0 else 0.0)


@_compiled
def effect_force(mechanics: Mechanics, effect: int, t_s: float, y: Floats, dy: Floats) -> float:
    """Strut force in N of one effect; the rate of its internal state goes into `dy`."""
    effects = mechanics.effects
    law = effects.places[effect, LAW]
    strut = int(effects.places[effect, STRUT])
    p = effects.parameters[effect]
    height_m = strut_height(mechanics.lower, strut, y)
    velocity_m_per_s = strut_rate(mechanics.lower, strut, y)
    deflection_m = height_m - mechanics.free_length_m[strut]
    if law <= Law.GAS_SPRING:
        return spring_effect(law, p, deflection_m)
    if law <= Law.BACKLASH:
        return contact_effect(law, p, height_m, velocity_m_per_s)
    if law <= Law.POSITION_DEPENDENT_DAMPING:
        return damping_effect(law, p, deflection_m, velocity_m_per_s)
    if law <= Law.MAXWELL:
        at = int(effects.places[effect, STATE])
        dy[at] = memory_rate(law, p, velocity_m_per_s, y[at])
        return memory_effect(law, p, y[at], dy[at])
    if law == Law.PERIODIC_FORCE:
        return p[0] * math.sin(2.0 * math.pi * p[1] * t_s + p[2])
    return 0.0


@_compiled
def strut_force(mechanics: Mechanics, strut: int, t_s: float, y: Floats, dy: Floats) -> float:
    """Total force of a strut in N; rates of temperature and internal states go into `dy`."""
    n = mechanics.mass_kg.shape[0]
    height_m = strut_height(mechanics.lower, strut, y)
    velocity_m_per_s = strut_rate(mechanics.lower, strut, y)
    damper_n = curve_force(mechanics.dampers, strut, velocity_m_per_s)
    effects = mechanics.effects.places.shape[0]
    if effects > 0:
        damper_n *= fade_factor(mechanics.effects, strut, t_s, float(y[2 * n]))
    dy[2 * n] -= mechanics.thermal.warming_k_per_j * damper_n * velocity_m_per_s
    force_n = curve_force(mechanics.springs, strut, height_m) + damper_n
    for effect in range(effects):
        if mechanics.effects.places[effect, STRUT] == strut:
            force_n += effect_force(mechanics, effect, t_s, y, dy)
    return force_n


@_compiled
def derivatives(mechanics: Mechanics, t_s: float, given: Floats, y: Floats, dy: Floats) -> None:
    """Rates of the whole state.

    Args:
        mechanics: The bench.
        t_s: Time in s.
        given: What the drive gives, shape (GIVEN,).
        y: State, shape (states,); an prescribed body is put where the drive has it.
        dy: Receives the rates, shape (states,).
    """
    n = mechanics.mass_kg.shape[0]
    thermal = mechanics.thermal
    prescribe(mechanics, given, y)
    dy[2 * n] = thermal.cooling_per_s * (thermal.ambient_c - y[2 * n])
    for i in range(n):
        dy[i] = y[n + i]
        dy[n + i] = 0.0
    dy[n + mechanics.driven] = given[0]
    for i in range(n):
        force_n = strut_force(mechanics, i, t_s, y, dy)
        dy[n + i] += force_n
        if mechanics.lower[i] >= 0:
            dy[n + mechanics.lower[i]] -= force_n
    for i in range(mechanics.effects.places.shape[0]):
        if mechanics.effects.places[i, LAW] == Law.HIDDEN_MASS:
            dy[n + mechanics.effects.places[i, STRUT]] += hidden_mass_force(mechanics, i, y, dy)
    for i in range(n):
        dy[n + i] = dy[n + i] / mechanics.mass_kg[i] - mechanics.gravity_m_per_s2


@_compiled
def hidden_mass_force(mechanics: Mechanics, effect: int, y: Floats, dy: Floats) -> float:
    """Force in N on the body that carries a hidden mass; its two states' rates go into `dy`.

    The states are the stretch of the mass's spring in m and the mass's velocity in m/s.
    """
    n = mechanics.mass_kg.shape[0]
    mass_kg = mechanics.effects.parameters[effect, 0]
    at = int(mechanics.effects.places[effect, STATE])
    stretch_rate_m_per_s = y[at + 1] - y[n + mechanics.effects.places[effect, STRUT]]
    force_n = mechanics.effects.parameters[effect, 1] * y[at]
    force_n += mechanics.effects.parameters[effect, 2] * stretch_rate_m_per_s
    dy[at] = stretch_rate_m_per_s
    dy[at + 1] = -force_n / mass_kg - mechanics.gravity_m_per_s2
    return force_n


@_compiled
def runge_kutta_step(
    mechanics: Mechanics, step: Step, given: Floats, y: Floats, work: Floats
) -> None:
    """Advance the state by one step of the classical fourth-order method.

    Args:
        mechanics: The bench.
        step: When the step is.
        given: What the drive gives at start, middle and end of the step, shape (3, GIVEN).
        y: State, shape (states,); changed in place.
        work: Scratch, shape (5, states).
    """
    t_s = step.t_s
    step_s = step.length_s
    half_s = 0.5 * step_s
    derivatives(mechanics, t_s, given[0], y, work[0])
    for j in range(y.shape[0]):
        work[4, j] = y[j] + half_s * work[0, j]
    derivatives(mechanics, t_s + half_s, given[1], work[4], work[1])
    for j in range(y.shape[0]):
        work[4, j] = y[j] + half_s * work[1, j]
    derivatives(mechanics, t_s + half_s, given[1], work[4], work[2])
    for j in range(y.shape[0]):
        work[4, j] = y[j] + step_s * work[2, j]
    derivatives(mechanics, t_s + step_s, given[2], work[4], work[3])
    for j in range(y.shape[0]):
        slope = work[0, j] + 2.0 * (work[1, j] + work[2, j]) + work[3, j]
        y[j] += step_s / 6.0 * slope
    prescribe(mechanics, given[2], y)


@_compiled
def observe(mechanics: Mechanics, drive: Drive, t_s: float, y: Floats, record: Floats) -> None:
    """Write what can be known of the bench at one time.

    Args:
        mechanics: The bench.
        drive: The applied force.
        t_s: Time in s.
        y: State, shape (states,).
        record: Receives height, rate of height and force of each strut, then applied force, acting
            force and temperature, shape (RECORD_COLUMNS * n + RECORD_EXTRA,).
    """
    n = mechanics.mass_kg.shape[0]
    rates = np.zeros(y.shape[0])
    for i in range(n):
        record[3 * i] = strut_height(mechanics.lower, i, y)
        record[3 * i + 1] = strut_rate(mechanics.lower, i, y)
        record[3 * i + 2] = strut_force(mechanics, i, t_s, y, rates)
    record[3 * n] = applied_force(drive.force, t_s)
    record[3 * n + 1] = acting_force(drive.force, t_s)
    record[3 * n + 2] = y[2 * n]


@_compiled
def advance(mechanics: Mechanics, drive: Drive, span: Span, y: Floats, records: Floats) -> None:
    """Write records at equal times, advancing the state to the time after the last one.

    Args:
        mechanics: The bench.
        drive: The applied force.
        span: Which records, and the steps between them.
        y: State at the first record, shape (states,); changed in place.
        records: Receives the records, shape (records, RECORD_COLUMNS * n + RECORD_EXTRA).
    """
    work = np.zeros((5, y.shape[0]))
    given = np.zeros((3, GIVEN))
    step_s = span.step_s
    for row in range(records.shape[0]):
        start = (span.first + row) * span.substeps
        give(mechanics, drive, start * step_s, given[2])
        prescribe(mechanics, given[2], y)
        observe(mechanics, drive, start * step_s, y, records[row])
        for i in range(start, start + span.substeps):
            given[0] = given[2]
            give(mechanics, drive, (i + 0.5) * step_s, given[1])
            give(mechanics, drive, (i + 1) * step_s, given[2])
            runge_kutta_step(mechanics, Step(i * step_s, step_s), given, y, work)
