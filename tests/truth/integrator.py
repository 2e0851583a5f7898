"""Classical Runge-Kutta of fourth order at 20 kHz or more, with sticking as an event.

The load is known at every step and half step, exactly, so no hold or interpolation enters.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from tests.truth import laws
from tests.truth.plant import Bench, Planted, Samples

MINIMUM_RATE_HZ = 20_000


@dataclass(frozen=True)
class Motion:
    """Truth at the samples: (n,) height, velocity, acceleration; (n, effects) forces; memories."""

    height_m: Samples
    velocity_m_per_s: Samples
    acceleration_m_per_s2: Samples
    force_n: Samples
    memory: Samples


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
    still = laws.Moment(bench, t, z, v, 0.0, gate)
    for e in range(system.codes.size):
        memory = y[at[e] : at[e + 1]]
        others += laws.force_n(system.codes[e], system.parameters[e], still, memory)
    a = _acceleration(others + held_n, mass, system.quadratic)
    for i in range(out.size):
        out[i] = 0.0
    out[0], out[1] = v, a
    moment = laws.Moment(bench, t, z, v, a, gate)
    for e in range(system.codes.size):
        memory, rate = y[at[e] : at[e + 1]], out[at[e] : at[e + 1]]
        laws.memory_rate(system.codes[e], system.parameters[e], moment, memory, rate)
    return others


@numba.njit(cache=True, error_model="numpy")
def _sliding_n(system, slip, v):
    """Friction of a dry surface that slides towards `slip`; none if there is none."""
    if slip == 0.0:
        return 0.0
    return -slip * laws.sliding_friction_n(system.parameters[system.stick], v)


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
def _advance(system, k, y, work):
    """One step of `y` in place."""
    slip = 0.0
    if system.stick >= 0:
        others = _derivative(system, 2 * k, y, 0.0, work[0])
        slip = _slip_direction(y, others, system.parameters[system.stick])
        if slip == 0.0:
            _stuck_step(system, k, others, y, work)
            return
    _runge_kutta(system, k, slip, y, work)
    # A sliding body that would turn round stops first, and then shows whether it sticks.
    if slip * y[1] < 0.0:
        y[1] = 0.0
    for e in range(system.codes.size):
        if system.codes[e] == laws.SLIP_ELEMENTS_CODE:
            memory = y[system.at[e] : system.at[e + 1]]
            laws.settle_slip_elements(system.parameters[e], y[0], memory)


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
    moment = laws.Moment(system.bench, t, y[0], y[1], a, system.gate[half])
    for e in range(system.codes.size):
        code, memory = system.codes[e], y[system.at[e] : system.at[e + 1]]
        forces[e] = laws.force_n(code, system.parameters[e], moment, memory)
        if code == laws.STICK:
            forces[e] = held
        elif code == laws.RIGID_MASS:
            forces[e] = -system.extra_mass_kg * (a + system.bench[4])
        elif code == laws.ACCEL_SQUARE:
            forces[e] = -system.quadratic * a * abs(a)
    return a


@numba.njit(cache=True, error_model="numpy")
def _run(system, steps, y):
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


def _numbers_of(effects: tuple[Planted, ...]) -> np.ndarray:
    return np.array([laws.NUMBER.get(effect.law, 0) for effect in effects], dtype=np.int64)


def _rows_of(effects: tuple[Planted, ...]) -> Samples:
    rows = [
        laws.parameter_row(effect.law, effect.truth)
        if effect.law in laws.NUMBER
        else np.zeros(laws.PARAMETERS_MAX)
        for effect in effects
    ]
    return np.array(rows).reshape(len(effects), laws.PARAMETERS_MAX)


def _sum_of(effects: tuple[Planted, ...], law: str) -> float:
    return sum((next(iter(e.truth.values())) for e in effects if e.law == law), 0.0)


class Drive(NamedTuple):
    """What the run imposes.

    Attributes:
        force_n: (2 n + 1,) all forces that depend on time alone, at steps and half steps.
        gate: (2 n + 1,) the switching signal, likewise.
        step_s: Length of a step.
        steps: Steps between two samples.
    """

    force_n: Samples
    gate: Samples
    step_s: float
    steps: int


def integrate(
    bench: Bench, effects: tuple[Planted, ...], drive: Drive, height_m: float, ambient_c: float
) -> Motion:
    """Integrate a bench from rest.

    Args:
        bench: Body, spring, damper.
        effects: What is planted; laws that are not in `laws.CODES` must already be in the drive.
        drive: What is imposed.
        height_m: Initial height.
        ambient_c: Ambient temperature.
    """
    codes = _numbers_of(effects)
    sizes = [laws.MEMORY.get(effect.law, 0) + 1 for effect in effects]
    at = 2 + np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    y = np.zeros(int(at[-1]))
    y[0] = height_m
    y[at[1:] - 1] = ambient_c
    for effect, start in zip(effects, at, strict=False):
        if effect.law == "slip_elements":
            y[start + laws.SLIP_ELEMENTS] = height_m
    dry = np.flatnonzero(codes == laws.STICK)
    system = System(
        bench=np.array(
            [
                bench.mass_kg,
                bench.stiffness_n_per_m,
                bench.damping_n_s_per_m,
                bench.free_length_m,
                bench.gravity_m_per_s2,
            ]
        ),
        codes=codes,
        parameters=_rows_of(effects),
        at=at,
        extra_mass_kg=_sum_of(effects, "rigid_mass"),
        quadratic=_sum_of(effects, "accel_square"),
        stick=int(dry[0]) if dry.size else -1,
        drive_n=drive.force_n,
        gate=drive.gate,
        step_s=drive.step_s,
    )
    states, accelerations, forces = _run(system, drive.steps, y)
    return Motion(states[:, 0], states[:, 1], accelerations, forces, states[:, 2:])
