"""Equations of motion of the bench.

Bodies move along the vertical axis. Strut i carries body i (bodies are ordered so) and stands on
the world or on an earlier body. The state of all is one vector:

    positions (n), velocities (n), temperature (1), internal states of the effects (any number)
"""

import math
from typing import NamedTuple

import numpy as np

from rig.simulated_bench.compilation import Floats, Integers, jit_compile
from rig.simulated_bench.curves import Curves, curve_force
from rig.simulated_bench.drive import BenchDrive, acting_force, applied_force, prescribed_motion
from rig.simulated_bench.laws import (
    LawCode,
    contact_force,
    damping_force,
    fade,
    spring_force,
    state_force,
    state_rate,
)

LAW, STRUT, STATE = 0, 1, 2
"""Columns of `Effects.indices`."""
INPUTS = 3
"""Number of inputs at a time: force on the driven body, prescribed height, its rate."""
RECORD_COLUMNS = 3
"""Columns of a record for each strut: height, rate of height, strut force."""
RECORD_EXTRA = 3
"""Columns of a record after those of the struts: applied force, acting force, temperature."""


class Effects(NamedTuple):
    """The undeclared effects that are laws of force.

    Attributes:
        indices: Code of each law, its strut, and the index of its first internal state in the state
            vector, shape (effects, 3).
        parameters: Values in the order of `rig.simulated_bench.effects`, shape (effects,
            PARAMETER_COUNT).
    """

    indices: Integers
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


class BenchMechanics(NamedTuple):
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


@jit_compile
def write_inputs(mechanics: BenchMechanics, drive: BenchDrive, t_s: float, inputs: Floats) -> None:
    """Write the inputs at a time, shape (INPUTS,)."""
    inputs[0] = acting_force(drive.force, t_s)
    if mechanics.prescribed >= 0:
        inputs[1], inputs[2] = prescribed_motion(drive.prescribed, t_s)


@jit_compile
def prescribe(mechanics: BenchMechanics, inputs: Floats, y: Floats) -> None:
    """Set position and rate of the body above the strut whose motion is prescribed."""
    body = mechanics.prescribed
    if body < 0:
        return
    n = mechanics.mass_kg.shape[0]
    below = int(mechanics.lower[body])
    y[body] = inputs[1] + (y[below] if below >= 0 else 0.0)
    y[n + body] = inputs[2] + (y[n + below] if below >= 0 else 0.0)


@jit_compile
def fade_factor(effects: Effects, strut: int, t_s: float, temperature_c: float) -> float:
    """Factor on the damper curve of a strut from all its fades."""
    factor = 1.0
    for i in range(effects.indices.shape[0]):
        if effects.indices[i, STRUT] == strut:
            factor *= fade(effects.indices[i, LAW], effects.parameters[i], t_s, temperature_c)
    return factor


@jit_compile
def strut_height(lower: Integers, strut: int, y: Floats) -> float:
    """Height of a strut in m."""
    below = int(lower[strut])
    return float(y[strut]) - (float(y[below]) if below >= 0 else 0.0)


@jit_compile
def strut_rate(lower: Integers, strut: int, y: Floats) -> float:
    """Rate of height of a strut in m/s."""
    n = lower.shape[0]
    below = int(lower[strut])
    return float(y[n + strut]) - (float(y[n + below]) if below >= 0 else 0.0)


@jit_compile
def effect_force(
    mechanics: BenchMechanics, effect: int, t_s: float, y: Floats, dy: Floats
) -> float:
    """Strut force in N of one effect; the rate of its internal state goes into `dy`."""
    effects = mechanics.effects
    law = effects.indices[effect, LAW]
    strut = int(effects.indices[effect, STRUT])
    p = effects.parameters[effect]
    height_m = strut_height(mechanics.lower, strut, y)
    velocity_m_per_s = strut_rate(mechanics.lower, strut, y)
    deflection_m = height_m - mechanics.free_length_m[strut]
    if law <= LawCode.GAS_SPRING:
        return spring_force(law, p, deflection_m)
    if law <= LawCode.BACKLASH:
        return contact_force(law, p, height_m, velocity_m_per_s)
    if law <= LawCode.POSITION_DEPENDENT_DAMPING:
        return damping_force(law, p, deflection_m, velocity_m_per_s)
    if law <= LawCode.MAXWELL:
        at = int(effects.indices[effect, STATE])
        dy[at] = state_rate(law, p, velocity_m_per_s, y[at])
        return state_force(law, p, y[at], dy[at])
    if law == LawCode.PERIODIC_FORCE:
        return p[0] * math.sin(2.0 * math.pi * p[1] * t_s + p[2])
    return 0.0


@jit_compile
def strut_force(mechanics: BenchMechanics, strut: int, t_s: float, y: Floats, dy: Floats) -> float:
    """Total force of a strut in N; rates of temperature and internal states go into `dy`."""
    n = mechanics.mass_kg.shape[0]
    height_m = strut_height(mechanics.lower, strut, y)
    velocity_m_per_s = strut_rate(mechanics.lower, strut, y)
    damper_n = curve_force(mechanics.dampers, strut, velocity_m_per_s)
    effects = mechanics.effects.indices.shape[0]
    if effects > 0:
        damper_n *= fade_factor(mechanics.effects, strut, t_s, float(y[2 * n]))
    dy[2 * n] -= mechanics.thermal.warming_k_per_j * damper_n * velocity_m_per_s
    force_n = curve_force(mechanics.springs, strut, height_m) + damper_n
    for effect in range(effects):
        if mechanics.effects.indices[effect, STRUT] == strut:
            force_n += effect_force(mechanics, effect, t_s, y, dy)
    return force_n


@jit_compile
def derivatives(
    mechanics: BenchMechanics, t_s: float, inputs: Floats, y: Floats, dy: Floats
) -> None:
    """Rates of the whole state.

    Args:
        mechanics: The bench.
        t_s: Time in s.
        inputs: Inputs at that time, shape (INPUTS,).
        y: State, shape (states,); a prescribed body is set to its motion.
        dy: Receives the rates, shape (states,).
    """
    n = mechanics.mass_kg.shape[0]
    thermal = mechanics.thermal
    prescribe(mechanics, inputs, y)
    dy[2 * n] = thermal.cooling_per_s * (thermal.ambient_c - y[2 * n])
    for i in range(n):
        dy[i] = y[n + i]
        dy[n + i] = 0.0
    dy[n + mechanics.driven] = inputs[0]
    for i in range(n):
        force_n = strut_force(mechanics, i, t_s, y, dy)
        dy[n + i] += force_n
        if mechanics.lower[i] >= 0:
            dy[n + mechanics.lower[i]] -= force_n
    for i in range(mechanics.effects.indices.shape[0]):
        if mechanics.effects.indices[i, LAW] == LawCode.HIDDEN_MASS:
            dy[n + mechanics.effects.indices[i, STRUT]] += hidden_mass_force(mechanics, i, y, dy)
    for i in range(n):
        dy[n + i] = dy[n + i] / mechanics.mass_kg[i] - mechanics.gravity_m_per_s2


@jit_compile
def hidden_mass_force(mechanics: BenchMechanics, effect: int, y: Floats, dy: Floats) -> float:
    """Force in N on the body that carries a hidden mass; its two states' rates go into `dy`.

    The states are the stretch of the mass's spring in m and the mass's velocity in m/s.
    """
    n = mechanics.mass_kg.shape[0]
    mass_kg = mechanics.effects.parameters[effect, 0]
    at = int(mechanics.effects.indices[effect, STATE])
    stretch_rate_m_per_s = y[at + 1] - y[n + mechanics.effects.indices[effect, STRUT]]
    force_n = mechanics.effects.parameters[effect, 1] * y[at]
    force_n += mechanics.effects.parameters[effect, 2] * stretch_rate_m_per_s
    dy[at] = stretch_rate_m_per_s
    dy[at + 1] = -force_n / mass_kg - mechanics.gravity_m_per_s2
    return force_n


@jit_compile
def observe(
    mechanics: BenchMechanics, drive: BenchDrive, t_s: float, y: Floats, record: Floats
) -> None:
    """Write the record of one time.

    Args:
        mechanics: The bench.
        drive: Applied force and prescribed motion.
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
