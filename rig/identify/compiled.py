"""The catalogue's laws as machine code, and the loops that run them over whole logs.

The very functions that the plant calls tick by tick are compiled here with one signature each, so
that the loops below take them as values and are compiled once for all effects.

Reference: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I (1993), II.1, for the
classical Runge-Kutta method.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from dart_model.effects.contract import Floats, Writable

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SLOTS = 5
"""Most effects that a simulation can carry."""

_VECTOR: Any = types.Array(types.float64, 1, "C")
_MATRIX: Any = types.Array(types.float64, 2, "C")
_INDEX: Any = types.Array(types.int64, 2, "C")
_F8: Any = types.float64
_FORCE_SIGNATURE: Any = _F8(_F8, _F8, _F8, _F8, _F8, _VECTOR, _VECTOR, _VECTOR)
_RATE_SIGNATURE: Any = types.void(
    _F8, _F8, _F8, _F8, _F8, _VECTOR, _VECTOR, _VECTOR, _VECTOR
)
_FORCE: Any = types.FunctionType(_FORCE_SIGNATURE)
_RATE: Any = types.FunctionType(_RATE_SIGNATURE)


class Law(NamedTuple):
    """A law as machine code: its force, and the rate of its memory."""

    force: Any
    rate: Any


def compile_loop(function: Callable[..., Any], signature: Any) -> Any:
    compiler = cast("Any", numba.njit)
    return compiler(signature, cache=True, error_model="numpy", nogil=True)(function)


def _no_memory(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    _p: Floats,
    _strut: Floats,
    _out: Writable,
) -> None:
    return


@functools.cache
def law(name: str) -> Law:
    """The law of an effect as machine code, compiled on first use and kept on disk."""
    item = effect(name)
    return Law(
        compile_loop(item.force, _FORCE_SIGNATURE),
        compile_loop(item.rate or _no_memory, _RATE_SIGNATURE),
    )


def compile_all() -> None:
    """Compile the whole catalogue."""
    for name in CATALOGUE:
        law(name)


class Slots(NamedTuple):
    """Effects as the loops read them.

    Attributes:
        laws: `SLOTS` laws; ``none`` where fewer effects are given.
        index: Strut, first parameter, past the last parameter, first memory state, past the last
            memory state of each slot, shape (SLOTS, 5).
        memory_size: Number of memory states of all.
    """

    laws: tuple[Law, ...]
    index: Integers
    memory_size: int


def slots(effects: tuple[tuple[int, str], ...]) -> Slots:
    """Slots for effects, each given by its strut and name."""
    index = np.zeros((SLOTS, 5), dtype=np.int64)
    laws: list[Law] = []
    parameter = memory = 0
    for row, (strut, name) in enumerate(effects):
        item = effect(name)
        index[row] = (
            strut,
            parameter,
            parameter + len(item.parameters),
            memory,
            memory + item.state_size,
        )
        parameter += len(item.parameters)
        memory += item.state_size
        laws.append(law(name))
    laws.extend([law("none")] * (SLOTS - len(laws)))
    return Slots(tuple(laws), index, memory)


def _derivative(  # noqa: PLR0915
    f0: Any, r0: Any, f1: Any, r1: Any, f2: Any, r2: Any, f3: Any, r3: Any, f4: Any, r4: Any,
    index: Integers, p: Array, struts: Array, rows: Array, offsets: Array,
    inverse_mass: Array, constant: Array, applied_row: Array,
    t: float, applied: float, temperature: float,
    x: Array, dx: Array, z: Array, w: Array, force: Array, general: Array,
) -> None:  # fmt: skip
    n = rows.shape[1]
    for i in range(rows.shape[0]):
        height = offsets[i]
        velocity = 0.0
        for j in range(n):
            height += rows[i, j] * x[j]
            velocity += rows[i, j] * x[n + j]
        z[i] = height
        w[i] = velocity
        force[i] = -struts[i, 1] * (height - struts[i, 0]) - struts[i, 2] * velocity
    m = 2 * n
    for k in range(5):
        if index[k, 2] == index[k, 1]:
            continue
        s = index[k, 0]
        own = p[index[k, 1] : index[k, 2]]
        memory = x[m + index[k, 3] : m + index[k, 4]]
        rate = dx[m + index[k, 3] : m + index[k, 4]]
        strut = struts[s]
        if k == 0:
            force[s] += f0(t, z[s], w[s], applied, temperature, memory, own, strut)
            r0(t, z[s], w[s], applied, temperature, memory, own, strut, rate)
        elif k == 1:
            force[s] += f1(t, z[s], w[s], applied, temperature, memory, own, strut)
            r1(t, z[s], w[s], applied, temperature, memory, own, strut, rate)
        elif k == 2:
            force[s] += f2(t, z[s], w[s], applied, temperature, memory, own, strut)
            r2(t, z[s], w[s], applied, temperature, memory, own, strut, rate)
        elif k == 3:
            force[s] += f3(t, z[s], w[s], applied, temperature, memory, own, strut)
            r3(t, z[s], w[s], applied, temperature, memory, own, strut, rate)
        else:
            force[s] += f4(t, z[s], w[s], applied, temperature, memory, own, strut)
            r4(t, z[s], w[s], applied, temperature, memory, own, strut, rate)
    for j in range(n):
        total = constant[j] + applied_row[j] * applied
        for i in range(rows.shape[0]):
            total += rows[i, j] * force[i]
        general[j] = total
    for j in range(n):
        acceleration = 0.0
        for i in range(n):
            acceleration += inverse_mass[j, i] * general[i]
        dx[j] = x[n + j]
        dx[n + j] = acceleration


_SLOT_TYPES = (_FORCE, _RATE) * SLOTS
_MODEL_TYPES = (_INDEX, _VECTOR, _MATRIX, _MATRIX, _VECTOR, _MATRIX, _VECTOR, _VECTOR)
_derivative_c = compile_loop(
    _derivative,
    types.void(*_SLOT_TYPES, *_MODEL_TYPES, _F8, _F8, _F8, *(_VECTOR,) * 6),
)


def _simulate(
    f0: Any, r0: Any, f1: Any, r1: Any, f2: Any, r2: Any, f3: Any, r3: Any, f4: Any, r4: Any,
    index: Integers, p: Array, struts: Array, rows: Array, offsets: Array,
    inverse_mass: Array, constant: Array, applied_row: Array,
    t: Array, fine: Array, temperature: Array, substeps: int, start: Array,
    heights: Array, velocities: Array, accelerations: Array,
) -> bool:  # fmt: skip
    n = rows.shape[1]
    struts_count = rows.shape[0]
    size = start.shape[0]
    x = start.copy()
    y = np.empty(size)
    k1 = np.zeros(size)
    k2 = np.zeros(size)
    k3 = np.zeros(size)
    k4 = np.zeros(size)
    z = np.zeros(struts_count)
    w = np.zeros(struts_count)
    force = np.zeros(struts_count)
    general = np.zeros(n)
    for k in range(t.shape[0]):
        at = 2 * substeps * k
        _derivative_c(
            f0, r0, f1, r1, f2, r2, f3, r3, f4, r4, index, p, struts, rows, offsets,
            inverse_mass, constant, applied_row, t[k], fine[at], temperature[k],
            x, k1, z, w, force, general,
        )  # fmt: skip
        for i in range(struts_count):
            heights[k, i] = z[i]
            velocities[k, i] = w[i]
            total = 0.0
            for j in range(n):
                total += rows[i, j] * k1[n + j]
            accelerations[k, i] = total
        if not abs(x[0]) < 1e6:
            return False
        if k + 1 == t.shape[0]:
            break
        h = (t[k + 1] - t[k]) / substeps
        rise = (temperature[k + 1] - temperature[k]) / substeps
        for step in range(substeps):
            now = t[k] + step * h
            warm = temperature[k] + step * rise
            if step > 0:
                _derivative_c(
                    f0, r0, f1, r1, f2, r2, f3, r3, f4, r4, index, p, struts, rows, offsets,
                    inverse_mass, constant, applied_row, now, fine[at + 2 * step], warm,
                    x, k1, z, w, force, general,
                )  # fmt: skip
            for i in range(size):
                y[i] = x[i] + 0.5 * h * k1[i]
            _derivative_c(
                f0, r0, f1, r1, f2, r2, f3, r3, f4, r4, index, p, struts, rows, offsets,
                inverse_mass, constant, applied_row, now + 0.5 * h, fine[at + 2 * step + 1],
                warm + 0.5 * rise, y, k2, z, w, force, general,
            )  # fmt: skip
            for i in range(size):
                y[i] = x[i] + 0.5 * h * k2[i]
            _derivative_c(
                f0, r0, f1, r1, f2, r2, f3, r3, f4, r4, index, p, struts, rows, offsets,
                inverse_mass, constant, applied_row, now + 0.5 * h, fine[at + 2 * step + 1],
                warm + 0.5 * rise, y, k3, z, w, force, general,
            )  # fmt: skip
            for i in range(size):
                y[i] = x[i] + h * k3[i]
            _derivative_c(
                f0, r0, f1, r1, f2, r2, f3, r3, f4, r4, index, p, struts, rows, offsets,
                inverse_mass, constant, applied_row, now + h, fine[at + 2 * step + 2],
                warm + rise, y, k4, z, w, force, general,
            )  # fmt: skip
            for i in range(size):
                x[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
    return True


simulate = compile_loop(
    _simulate,
    types.boolean(
        *_SLOT_TYPES, *_MODEL_TYPES,
        _VECTOR, _VECTOR, _VECTOR, types.int64, _VECTOR, _MATRIX, _MATRIX, _MATRIX,
    ),
)  # fmt: skip
"""Run a model open loop.

Args: the laws; index, parameters, strut constants (struts, 4), strut rows (struts, n), offsets
(struts,), inverse mass (n, n), constant generalised force (n,), applied row (n,); times of the
nodes (N,), applied force at half sub-steps (2 * substeps * (N - 1) + 1,), temperature (N,),
sub-steps, start (2 n + memory,); heights, velocities and accelerations of the struts (N, struts),
written. Returns whether the motion stayed finite.
"""


def _along(
    force: Any, rate: Any, p: Array, strut: Array, t: Array, z: Array, w: Array,
    applied: Array, temperature: Array, substeps: int, start: Array, out: Array,
) -> None:  # fmt: skip
    size = start.shape[0]
    s = start.copy()
    y = np.empty(size)
    k1 = np.zeros(size)
    k2 = np.zeros(size)
    for k in range(t.shape[0]):
        out[k] = force(t[k], z[k], w[k], applied[k], temperature[k], s, p, strut)
        if size == 0 or k + 1 == t.shape[0]:
            continue
        h = (t[k + 1] - t[k]) / substeps
        dz = (z[k + 1] - z[k]) / substeps
        dw = (w[k + 1] - w[k]) / substeps
        da = (applied[k + 1] - applied[k]) / substeps
        for step in range(substeps):
            a = float(step)
            b = step + 0.5
            rate(
                t[k] + a * h, z[k] + a * dz, w[k] + a * dw, applied[k] + a * da,
                temperature[k], s, p, strut, k1,
            )  # fmt: skip
            for i in range(size):
                y[i] = s[i] + 0.5 * h * k1[i]
            rate(
                t[k] + b * h, z[k] + b * dz, w[k] + b * dw, applied[k] + b * da,
                temperature[k], y, p, strut, k2,
            )  # fmt: skip
            for i in range(size):
                s[i] += h * k2[i]


along = compile_loop(
    _along,
    types.void(
        _FORCE, _RATE, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR,
        types.int64, _VECTOR, _VECTOR,
    ),
)  # fmt: skip
"""Force of one law along a known motion: parameters, strut constants (4,), then times, heights,
velocities, applied force and temperature (N,), sub-steps for the memory, its start; force, written.
"""


def _respond(
    transition: Array, early: Array, late: Array, output: Array, forces: Array, heights: Array
) -> None:
    size = transition.shape[0]
    x = np.zeros(size)
    y = np.zeros(size)
    for k in range(forces.shape[0]):
        for i in range(output.shape[0]):
            total = 0.0
            for j in range(size):
                total += output[i, j] * x[j]
            heights[k, i] = total
        if k + 1 == forces.shape[0]:
            break
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += transition[i, j] * x[j]
            for j in range(forces.shape[1]):
                total += early[i, j] * forces[k, j] + late[i, j] * forces[k + 1, j]
            y[i] = total
        for i in range(size):
            x[i] = y[i]


respond = compile_loop(_respond, types.void(*(_MATRIX,) * 6))
"""Heights (N, struts), written, of the linear model from rest under forces (N, n): transition,
input matrices for the force before and after each step, and output matrix of its discretisation."""
