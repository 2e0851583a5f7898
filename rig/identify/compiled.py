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
_RATE_SIGNATURE: Any = types.void(_F8, _F8, _F8, _F8, _F8, _VECTOR, _VECTOR, _VECTOR, _VECTOR)
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


_SLOT_TYPES = (_FORCE, _RATE) * SLOTS
_MODEL_TYPES = (_INDEX, _VECTOR, _MATRIX, _MATRIX, _VECTOR, _MATRIX, _VECTOR, _VECTOR)


def _slot_force(
    force: Any, rate: Any, t: float, z: float, w: float, applied: float, temperature: float,
    memory: Array, p: Array, strut: Array, out: Array,
) -> float:  # fmt: skip
    if p.shape[0] == 0:
        return 0.0
    if memory.shape[0] > 0:
        rate(t, z, w, applied, temperature, memory, p, strut, out)
    value: float = force(t, z, w, applied, temperature, memory, p, strut)
    return value


_slot_force_c = compile_loop(
    _slot_force,
    _F8(_FORCE, _RATE, _F8, _F8, _F8, _F8, _F8, _VECTOR, _VECTOR, _VECTOR, _VECTOR),
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
    m = 2 * n
    # One state and one rate are evaluated again and again, so that the views below stay valid.
    x = start.copy()
    y = start.copy()
    dy = np.zeros(size)
    total = np.zeros(size)
    z = np.zeros(struts_count)
    w = np.zeros(struts_count)
    force = np.zeros(struts_count)
    general = np.zeros(n)
    p0 = p[index[0, 1] : index[0, 2]]
    p1 = p[index[1, 1] : index[1, 2]]
    p2 = p[index[2, 1] : index[2, 2]]
    p3 = p[index[3, 1] : index[3, 2]]
    p4 = p[index[4, 1] : index[4, 2]]
    s0 = y[m + index[0, 3] : m + index[0, 4]]
    s1 = y[m + index[1, 3] : m + index[1, 4]]
    s2 = y[m + index[2, 3] : m + index[2, 4]]
    s3 = y[m + index[3, 3] : m + index[3, 4]]
    s4 = y[m + index[4, 3] : m + index[4, 4]]
    d0 = dy[m + index[0, 3] : m + index[0, 4]]
    d1 = dy[m + index[1, 3] : m + index[1, 4]]
    d2 = dy[m + index[2, 3] : m + index[2, 4]]
    d3 = dy[m + index[3, 3] : m + index[3, 4]]
    d4 = dy[m + index[4, 3] : m + index[4, 4]]
    i0, i1, i2, i3, i4 = index[0, 0], index[1, 0], index[2, 0], index[3, 0], index[4, 0]
    k0, k1, k2, k3, k4 = struts[i0], struts[i1], struts[i2], struts[i3], struts[i4]
    count = 0
    for row in range(5):
        if index[row, 2] > index[row, 1]:
            count = row + 1
    for k in range(t.shape[0]):
        last = k + 1 == t.shape[0]
        h = 0.0
        rise = 0.0
        if not last:
            h = (t[k + 1] - t[k]) / substeps
            rise = (temperature[k + 1] - temperature[k]) / substeps
        for step in range(substeps):
            for stage in range(4):
                # Classical Runge-Kutta: nodes 0, 1/2, 1/2, 1; weights 1, 2, 2, 1.
                half = (stage + 1) // 2
                if stage == 0:
                    for i in range(size):
                        y[i] = x[i]
                else:
                    reach = h if stage == 3 else 0.5 * h
                    for i in range(size):
                        y[i] = x[i] + reach * dy[i]
                now = t[k] + (step + 0.5 * half) * h
                warm = temperature[k] + (step + 0.5 * half) * rise
                applied = fine[min(2 * (substeps * k + step) + half, fine.shape[0] - 1)]
                for i in range(struts_count):
                    height = offsets[i]
                    velocity = 0.0
                    for j in range(n):
                        height += rows[i, j] * y[j]
                        velocity += rows[i, j] * y[n + j]
                    z[i] = height
                    w[i] = velocity
                    force[i] = -struts[i, 1] * (height - struts[i, 0]) - struts[i, 2] * velocity
                if count > 0:
                    force[i0] += _slot_force_c(
                        f0, r0, now, z[i0], w[i0], applied, warm, s0, p0, k0, d0
                    )
                if count > 1:
                    force[i1] += _slot_force_c(
                        f1, r1, now, z[i1], w[i1], applied, warm, s1, p1, k1, d1
                    )
                if count > 2:
                    force[i2] += _slot_force_c(
                        f2, r2, now, z[i2], w[i2], applied, warm, s2, p2, k2, d2
                    )
                if count > 3:
                    force[i3] += _slot_force_c(
                        f3, r3, now, z[i3], w[i3], applied, warm, s3, p3, k3, d3
                    )
                if count > 4:
                    force[i4] += _slot_force_c(
                        f4, r4, now, z[i4], w[i4], applied, warm, s4, p4, k4, d4
                    )
                for j in range(n):
                    sum_n = constant[j] + applied_row[j] * applied
                    for i in range(struts_count):
                        sum_n += rows[i, j] * force[i]
                    general[j] = sum_n
                for j in range(n):
                    acceleration = 0.0
                    for i in range(n):
                        acceleration += inverse_mass[j, i] * general[i]
                    dy[j] = y[n + j]
                    dy[n + j] = acceleration
                if stage == 0:
                    if step == 0:
                        for i in range(struts_count):
                            heights[k, i] = z[i]
                            velocities[k, i] = w[i]
                            along_strut = 0.0
                            for j in range(n):
                                along_strut += rows[i, j] * dy[n + j]
                            accelerations[k, i] = along_strut
                        if last:
                            return True
                    for i in range(size):
                        total[i] = dy[i]
                elif stage == 3:
                    for i in range(size):
                        x[i] += h / 6.0 * (total[i] + dy[i])
                else:
                    for i in range(size):
                        total[i] += 2.0 * dy[i]
        if not abs(x[0]) < 1e6:
            return False
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
    if size == 2 and output.shape[0] == 1 and forces.shape[1] == 1:
        a00, a01, a10, a11 = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
        b0, b1, c0, c1 = early[0, 0], early[1, 0], late[0, 0], late[1, 0]
        g0, g1 = output[0, 0], output[0, 1]
        u = 0.0
        v = 0.0
        for k in range(forces.shape[0]):
            heights[k, 0] = g0 * u + g1 * v
            if k + 1 < forces.shape[0]:
                f = forces[k, 0]
                g = forces[k + 1, 0]
                u, v = a00 * u + a01 * v + b0 * f + c0 * g, a10 * u + a11 * v + b1 * f + c1 * g
        return
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
