"""Equations of motion of the bench.

Bodies move along the vertical axis; a rigid body heaves, pitches and rolls on the struts that carry
it. A strut stands on the world or on an earlier body; its height is the vertical distance of its
ends. The state of all is one vector:

    positions (n), velocities (n), temperature (1), internal states of the effects (any number)

A body on a guide has one position, a rigid one three: the height of its centre of mass, its pitch
and its roll in rad. It is turned by the roll about its own x axis first and then by the pitch about
the y axis.

Reference: Goldstein, "Classical Mechanics" (1980), 4.4 and 5.5: Euler angles and rotating bodies.
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


class Ends(NamedTuple):
    """The ends of the struts, the lower ones before the upper ones.

    Attributes:
        size: Number of positions, n.
        positions: That each end moves with, -1 for the world, shape (struts, 2).
        is_rigid: 1 where it is the first one of a rigid body, else 0, shape (struts, 2).
        places_m: Where on a rigid body the end is, along its x and y axes, shape (struts, 2, 2).
    """

    size: int
    positions: Integers
    is_rigid: Integers
    places_m: Floats


class RigidBodies(NamedTuple):
    """The bodies that heave, pitch and roll.

    Attributes:
        first: First position of each, shape (bodies,).
        more_kg_m2: Moment of inertia about its own z axis less that about y, shape (bodies,).
    """

    first: Integers
    more_kg_m2: Floats


class BenchMechanics(NamedTuple):
    """The bench as the equations of motion see it.

    Few arrays, because compiled code counts references to each of them on every call.

    Attributes:
        gravity_m_per_s2: Acceleration of free fall.
        inertia: Of each position: mass in kg, or moment of inertia in kg·m², shape (n,).
        is_height: 1 where it is a height, 0 where it is an angle, shape (n,).
        rigid: Bodies that heave, pitch and roll.
        ends: Where the struts are.
        driven: Position on which the applied force acts.
        prescribed: Struts whose motion is prescribed, shape (motions,).
        free_length_m: Free length of each strut, shape (struts,).
        springs: Spring curves over height.
        dampers: Damper curves over rate of height.
        effects: Undeclared effects.
        thermal: The damper's temperature.
    """

    gravity_m_per_s2: float
    inertia: Floats
    is_height: Floats
    rigid: RigidBodies
    ends: Ends
    driven: int
    prescribed: Integers
    free_length_m: Floats
    springs: Curves
    dampers: Curves
    effects: Effects
    thermal: Thermal


@jit_compile
def write_inputs(mechanics: BenchMechanics, drive: BenchDrive, t_s: float, inputs: Floats) -> None:
    """Write the inputs at a time: acting force, then each prescribed height and its rate."""
    inputs[0] = acting_force(drive.force, t_s)
    for i in range(mechanics.prescribed.shape[0]):
        inputs[1 + 2 * i], inputs[2 + 2 * i] = prescribed_motion(drive.prescribed, i, t_s)


@jit_compile
def prescribe(mechanics: BenchMechanics, inputs: Floats, y: Floats) -> None:
    """Set position and rate of the bodies above the struts whose motion is prescribed."""
    n = mechanics.ends.size
    for i in range(mechanics.prescribed.shape[0]):
        strut = mechanics.prescribed[i]
        below, body = mechanics.ends.positions[strut, 0], mechanics.ends.positions[strut, 1]
        y[body] = inputs[1 + 2 * i] + (y[below] if below >= 0 else 0.0)
        y[n + body] = inputs[2 + 2 * i] + (y[n + below] if below >= 0 else 0.0)


@jit_compile
def fade_factor(effects: Effects, strut: int, t_s: float, temperature_c: float) -> float:
    """Factor on the damper curve of a strut from all its fades."""
    factor = 1.0
    for i in range(effects.indices.shape[0]):
        if effects.indices[i, STRUT] == strut:
            factor *= fade(effects.indices[i, LAW], effects.parameters[i], t_s, temperature_c)
    return factor


@jit_compile
def strut_height(ends: Ends, strut: int, y: Floats) -> float:
    """Height of a strut in m."""
    return end_height(ends, strut, 1, y) - end_height(ends, strut, 0, y)


@jit_compile
def strut_rate(ends: Ends, strut: int, y: Floats) -> float:
    """Rate of height of a strut in m/s."""
    return end_rate(ends, strut, 1, y) - end_rate(ends, strut, 0, y)


@jit_compile
def end_height(ends: Ends, strut: int, end: int, y: Floats) -> float:
    """Height of an end of a strut in m."""
    at = ends.positions[strut, end]
    if at < 0:
        return 0.0
    if ends.is_rigid[strut, end] == 0:
        return float(y[at])
    x_m, y_m = ends.places_m[strut, end, 0], ends.places_m[strut, end, 1]
    pitch, roll = y[at + 1], y[at + 2]
    return float(y[at] - x_m * math.sin(pitch) + y_m * math.sin(roll) * math.cos(pitch))


@jit_compile
def end_slopes(ends: Ends, strut: int, end: int, y: Floats) -> tuple[float, float]:
    """Derivatives of the height of an end on a rigid body by pitch and roll, in m/rad."""
    at = ends.positions[strut, end]
    x_m, y_m = ends.places_m[strut, end, 0], ends.places_m[strut, end, 1]
    pitch, roll = y[at + 1], y[at + 2]
    by_pitch = -x_m * math.cos(pitch) - y_m * math.sin(roll) * math.sin(pitch)
    return by_pitch, y_m * math.cos(roll) * math.cos(pitch)


@jit_compile
def end_rate(ends: Ends, strut: int, end: int, y: Floats) -> float:
    """Velocity of an end of a strut in m/s."""
    at = ends.positions[strut, end]
    if at < 0:
        return 0.0
    rates = at + ends.size
    if ends.is_rigid[strut, end] == 0:
        return float(y[rates])
    by_pitch, by_roll = end_slopes(ends, strut, end, y)
    return float(y[rates] + by_pitch * y[rates + 1] + by_roll * y[rates + 2])


@jit_compile
def push(ends: Ends, strut: int, end: int, force_n: float, y: Floats, dy: Floats) -> None:
    """Add an upward force at an end of a strut to the generalised forces in `dy`."""
    at = ends.positions[strut, end]
    if at < 0:
        return
    rates = at + ends.size
    dy[rates] += force_n
    if ends.is_rigid[strut, end] != 0:
        by_pitch, by_roll = end_slopes(ends, strut, end, y)
        dy[rates + 1] += by_pitch * force_n
        dy[rates + 2] += by_roll * force_n


@jit_compile
def effect_force(
    mechanics: BenchMechanics, effect: int, t_s: float, y: Floats, dy: Floats
) -> float:
    """Strut force in N of one effect; the rate of its internal state goes into `dy`."""
    effects = mechanics.effects
    law = effects.indices[effect, LAW]
    strut = int(effects.indices[effect, STRUT])
    p = effects.parameters[effect]
    height_m = strut_height(mechanics.ends, strut, y)
    velocity_m_per_s = strut_rate(mechanics.ends, strut, y)
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
    n = mechanics.inertia.shape[0]
    height_m = strut_height(mechanics.ends, strut, y)
    velocity_m_per_s = strut_rate(mechanics.ends, strut, y)
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
        inputs: Inputs at that time, as of `write_inputs`.
        y: State, shape (states,); prescribed bodies are set to their motions.
        dy: Receives the rates, shape (states,).
    """
    n = mechanics.inertia.shape[0]
    thermal = mechanics.thermal
    prescribe(mechanics, inputs, y)
    dy[2 * n] = thermal.cooling_per_s * (thermal.ambient_c - y[2 * n])
    for i in range(n):
        dy[i] = y[n + i]
        dy[n + i] = 0.0
    dy[n + mechanics.driven] = inputs[0]
    for i in range(mechanics.ends.positions.shape[0]):
        force_n = strut_force(mechanics, i, t_s, y, dy)
        push(mechanics.ends, i, 1, force_n, y, dy)
        push(mechanics.ends, i, 0, -force_n, y, dy)
    for i in range(mechanics.effects.indices.shape[0]):
        if mechanics.effects.indices[i, LAW] == LawCode.HIDDEN_MASS:
            strut = int(mechanics.effects.indices[i, STRUT])
            push(mechanics.ends, strut, 1, hidden_mass_force(mechanics, i, y, dy), y, dy)
    accelerate(mechanics, y, dy)


@jit_compile
def accelerate(mechanics: BenchMechanics, y: Floats, dy: Floats) -> None:
    """Turn the generalised forces in `dy` into accelerations."""
    n = mechanics.inertia.shape[0]
    for i in range(n):
        fall = mechanics.gravity_m_per_s2 * mechanics.is_height[i]
        dy[n + i] = dy[n + i] / mechanics.inertia[i] - fall
    for k in range(mechanics.rigid.first.shape[0]):
        at, more = mechanics.rigid.first[k], mechanics.rigid.more_kg_m2[k]
        roll, pitch_rate, roll_rate = y[at + 2], y[n + at + 1], y[n + at + 2]
        twist = more * math.sin(roll) * math.cos(roll)
        moment = mechanics.inertia[at + 1] * dy[n + at + 1] - 2.0 * pitch_rate * roll_rate * twist
        dy[n + at + 1] = moment / (mechanics.inertia[at + 1] + more * math.sin(roll) ** 2)
        dy[n + at + 2] += pitch_rate**2 * twist / mechanics.inertia[at + 2]


@jit_compile
def hidden_mass_force(mechanics: BenchMechanics, effect: int, y: Floats, dy: Floats) -> float:
    """Force in N on the body that carries a hidden mass; its two states' rates go into `dy`.

    The states are the stretch of the mass's spring in m and the mass's velocity in m/s.
    """
    mass_kg = mechanics.effects.parameters[effect, 0]
    at = int(mechanics.effects.indices[effect, STATE])
    strut = int(mechanics.effects.indices[effect, STRUT])
    stretch_rate_m_per_s = y[at + 1] - end_rate(mechanics.ends, strut, 1, y)
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
        drive: Applied force and prescribed motions.
        t_s: Time in s.
        y: State, shape (states,).
        record: Receives height, rate of height and force of each strut, then applied force, acting
            force and temperature, shape (RECORD_COLUMNS * struts + RECORD_EXTRA,).
    """
    rates = np.zeros(y.shape[0])
    struts = mechanics.ends.positions.shape[0]
    for i in range(struts):
        record[3 * i] = strut_height(mechanics.ends, i, y)
        record[3 * i + 1] = strut_rate(mechanics.ends, i, y)
        record[3 * i + 2] = strut_force(mechanics, i, t_s, y, rates)
    record[3 * struts] = applied_force(drive.force, t_s)
    record[3 * struts + 1] = acting_force(drive.force, t_s)
    record[3 * struts + 2] = y[2 * mechanics.inertia.shape[0]]
