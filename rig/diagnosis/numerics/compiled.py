"""The catalogue's laws as machine code, and the loops that run them over whole logs.

The very functions that the plant calls tick by tick are compiled here with one signature each, so
that the loops below take them as values (numba's first-class functions) and are compiled once for
all effects.

Reference: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I (1993), II.1, for the
classical Runge-Kutta method.
"""

# numba ships no types, and what it compiles is read by numba, not by a type checker.
# pyright: basic, reportCallIssue=false

import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaExperimentalFeatureWarning
from numba.typed import List
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.calling import force_over_arrays, rates_over_arrays

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Cube = NDArray[np.float64]

SLOTS = 10
"""Most effects that a simulation carries: the loops know their number when they are compiled."""

_F8: Any = types.float64
_I8: Any = types.int64
_VECTOR: Any = types.Array(types.float64, 1, "C")
_MATRIX: Any = types.Array(types.float64, 2, "C")
_CUBE: Any = types.Array(types.float64, 3, "C")
_INTEGERS: Any = types.Array(types.int64, 1, "C")
_INDEX: Any = types.Array(types.int64, 2, "C")
_POINTER: Any = types.CPointer(types.float64)
_FORCE_SIGNATURE: Any = _F8(*(_F8,) * 5, *(_POINTER,) * 3)
_RATE_SIGNATURE: Any = types.void(*(_F8,) * 5, *(_POINTER,) * 4)
_FORCE: Any = types.FunctionType(_FORCE_SIGNATURE)
_RATE: Any = types.FunctionType(_RATE_SIGNATURE)
_FORCES: Any = types.ListType(_FORCE)
_RATES: Any = types.ListType(_RATE)
_TEN_FORCES: Any = types.UniTuple(_FORCE, SLOTS)
_TEN_RATES: Any = types.UniTuple(_RATE, SLOTS)
_TEN_POINTERS: Any = types.UniTuple(_POINTER, SLOTS)


class Law(NamedTuple):
    """A law as machine code.

    Attributes:
        forces: Its force, a list of one.
        rates: Its internal state's rate, a list of one.
        states: Number of internal states.
    """

    forces: Any
    rates: Any
    states: int


def compile_loop(function: Callable[..., Any], signature: Any) -> Any:
    """A function as machine code for one signature, kept on disk, without the global lock."""
    compiler = cast("Any", numba.njit)
    return compiler(signature, cache=True, error_model="numpy", nogil=True)(function)


def _compile_law(function: Callable[..., Any], signature: Any) -> Any:
    # A law only reads and writes by index, so bare pointers do, which cost least in a call.
    compiler = cast("Any", numba.cfunc)
    return compiler(signature, cache=True, error_model="numpy")(function)


_KEPT: list[Any] = []
"""Machine code whose addresses are in use: the lists below hold no references."""


@functools.cache
def _compiled_force(name: str) -> Any:
    force = _compile_law(force_over_arrays(effect(name)), _FORCE_SIGNATURE)
    _KEPT.append(force)
    return force


@functools.cache
def _compiled_rate(name: str) -> Any:
    rate = _compile_law(rates_over_arrays(effect(name)), _RATE_SIGNATURE)
    _KEPT.append(rate)
    return rate


def _compiled(name: str) -> tuple[Any, Any]:
    return _compiled_force(name), _compiled_rate(name if effect(name).rate else "none")


def _empty() -> tuple[Any, Any]:
    return List.empty_list(_FORCE), List.empty_list(_RATE)


def _append(forces: Any, rates: Any, force: Any, rate: Any) -> None:
    forces.append(force)
    rates.append(rate)


_empty = compile_loop(_empty, types.Tuple((_FORCES, _RATES))())
_append = compile_loop(_append, types.void(_FORCES, _RATES, _FORCE, _RATE))


def _listed(names: tuple[str, ...]) -> tuple[Any, Any]:
    # The interpreter is asked for a function's address once, here; it would be at every call of a
    # loop that took functions themselves, for longer than a short loop runs. They are appended one
    # by one, because numba warns of a tuple of functions, and a thread cannot silence warnings
    # without silencing other threads'.
    forces, rates = _empty()
    for name in names:
        _append(forces, rates, *_compiled(name))
    return forces, rates


@functools.cache
def law(name: str) -> Law:
    """The law of an effect as machine code, compiled on first use and kept on disk."""
    return Law(*_listed((name,)), effect(name).state_size)


class Slots(NamedTuple):
    """Placed effects as the loops read them.

    Attributes:
        forces: Their forces, a list filled up to `SLOTS`.
        rates: Their internal states' rates, likewise.
        index: For each effect its strut, first parameter, past the last parameter, first internal
            state and past the last one, shape (effects, 5).
        parameters: Number of parameters of all.
        states: Number of internal states of all.
    """

    forces: Any
    rates: Any
    index: Integers
    parameters: int
    states: int


@functools.lru_cache(maxsize=4096)
def slots(effects: tuple[tuple[int, str], ...]) -> Slots:
    """Slots for effects, each given by its strut and name.

    Raises:
        ValueError: There are more than `SLOTS`.
    """
    if len(effects) > SLOTS:
        raise ValueError(f"{len(effects)} effects in one simulation, which carries at most {SLOTS}")
    index = np.zeros((len(effects), 5), dtype=np.int64)
    parameter = state = 0
    for row, (strut, name) in enumerate(effects):
        item = effect(name)
        past_parameter, past_state = parameter + len(item.parameters), state + item.state_size
        index[row] = strut, parameter, past_parameter, state, past_state
        parameter, state = past_parameter, past_state
    names = tuple(name for _, name in effects) + ("none",) * (SLOTS - len(effects))
    return Slots(*_listed(names), index, parameter, state)


def _ten(f: Any) -> Any:
    return f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9]


with warnings.catch_warnings():
    # While numba compiles this, not once it is on disk, it warns that functions as values are new.
    warnings.simplefilter("ignore", NumbaExperimentalFeatureWarning)
    _ten = compile_loop(_ten, [_TEN_FORCES(_FORCES), _TEN_RATES(_RATES)])


def _pointer(array: Array, first: int) -> Any:
    return array[first:].ctypes


def _pointers(a: Array, at: Integers) -> Any:
    return (
        a[at[0] :].ctypes, a[at[1] :].ctypes, a[at[2] :].ctypes, a[at[3] :].ctypes,
        a[at[4] :].ctypes, a[at[5] :].ctypes, a[at[6] :].ctypes, a[at[7] :].ctypes,
        a[at[8] :].ctypes, a[at[9] :].ctypes,
    )  # fmt: skip


# An array's `ctypes` becomes a bare pointer only where a signature asks for one.
_pointer = compile_loop(_pointer, _POINTER(_VECTOR, _I8))
_pointers = compile_loop(_pointers, _TEN_POINTERS(_VECTOR, _INTEGERS))


_PIECES = 8
"""Parts into which a step is cut where a force jumps."""
_MOST_PIECES = 32
"""The same where it jumps within one of these, as friction does that is all but a sign."""

_LARGEST_ERROR = 5e-8
"""Change of height within a step by a jump of force, as a share of the stroke, from which on the
step is cut: a tenth of the resolution of usual height sensors over their range."""


def _march(
    forces: Any, rates: Any, own: Any, slopes: Any, values: Any, constants: Any,
    y: Array, dy: Array, index: Integers, struts: Array,
    mass_inverse: Cube, bias: Array, bias_q: Cube, bias_v: Cube, rows: Cube, heights0: Array,
    applied: Array, q0: Array, v0: Array,
    t: Array, fine: Array, temperature: Array, substeps: int, bend: float, stroke: float,
    start: Array, heights: Array, velocities: Array, accelerations: Array,
) -> bool:  # fmt: skip
    # Laws take bare pointers, because an array would be counted as held and released at each call.
    # The pointers come as arguments: numba has no arithmetic to make them of others in the loop,
    # and to cut an array there for each call takes longer than most laws.
    n = rows.shape[2]
    count = rows.shape[1]
    tabulated = rows.shape[0] > 1
    size = start.shape[0]
    x = start.copy()
    began = start.copy()
    total = np.zeros(size)
    twist = np.zeros(n)
    z = np.zeros(count)
    w = np.zeros(count)
    force = np.zeros(count)
    general = np.zeros(n)
    q = q0[0].copy()
    v = v0[0].copy()
    least = _LARGEST_ERROR * stroke
    for k in range(t.shape[0]):
        last = k + 1 == t.shape[0]
        after = k if last else k + 1
        gap = 0.0 if last else t[k + 1] - t[k]
        whole = gap / substeps
        a = k if tabulated else 0
        b = after if tabulated else 0
        for step in range(substeps):
            at = min(2 * (substeps * k + step), fine.shape[0] - 1)
            f0 = fine[at]
            f1 = fine[min(at + 1, fine.shape[0] - 1)]
            f2 = fine[min(at + 2, fine.shape[0] - 1)]
            for i in range(size):
                began[i] = x[i]
            pieces = 1
            piece = 0
            while piece < pieces:
                h = whole / pieces
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
                    u = (piece + 0.5 * half) / pieces
                    share = (step + u) / substeps
                    now = t[k] + (step + u) * whole
                    warm = temperature[k] + share * (temperature[after] - temperature[k])
                    load = (
                        f0 * (1.0 - u) * (1.0 - 2.0 * u)
                        + 4.0 * f1 * u * (1.0 - u)
                        + f2 * u * (2.0 * u - 1.0)
                    )
                    if tabulated:
                        # Hermite's cubic between nodes: a chord would cut the motion's bends.
                        for j in range(n):
                            rise = q0[b, j] - q0[a, j]
                            early = gap * v0[a, j]
                            late = gap * v0[b, j]
                            turn = early + late - 2.0 * rise
                            sag = 3.0 * rise - 2.0 * early - late
                            q[j] = q0[a, j] + share * (early + share * (sag + share * turn))
                            v[j] = v0[a, j]
                            if gap > 0.0:
                                v[j] = (early + share * (2.0 * sag + 3.0 * share * turn)) / gap
                    for i in range(count):
                        height = heights0[a, i]
                        if tabulated:
                            # Heights follow the reference by a cubic, to first order beside it.
                            rise = heights0[b, i] - heights0[a, i]
                            early = 0.0
                            late = 0.0
                            for j in range(n):
                                early += gap * rows[a, i, j] * v0[a, j]
                                late += gap * rows[b, i, j] * v0[b, j]
                            turn = early + late - 2.0 * rise
                            sag = 3.0 * rise - 2.0 * early - late
                            height += share * (early + share * (sag + share * turn))
                        velocity = 0.0
                        for j in range(n):
                            row = rows[a, i, j] + share * (rows[b, i, j] - rows[a, i, j])
                            height += row * (y[j] - q[j])
                            velocity += row * y[n + j]
                        z[i] = height
                        w[i] = velocity
                        force[i] = (
                            struts[i, 4]
                            - struts[i, 1] * (height - struts[i, 0])
                            - struts[i, 2] * velocity
                        )
                    for slot in range(SLOTS):
                        # A fixed number of turns is unrolled, so that no tuple is searched.
                        if slot >= index.shape[0]:
                            break
                        i = index[slot, 0]
                        if index[slot, 4] > index[slot, 3]:
                            rates[slot](
                                now, z[i], w[i], load, warm,
                                own[slot], values[slot], constants[slot], slopes[slot],
                            )  # fmt: skip
                        force[i] += forces[slot](
                            now, z[i], w[i], load, warm, own[slot], values[slot], constants[slot]
                        )
                    for j in range(n):
                        sum_n = bias[a, j] + share * (bias[b, j] - bias[a, j])
                        sum_n += (applied[a, j] + share * (applied[b, j] - applied[a, j])) * load
                        for i in range(count):
                            row = rows[a, i, j] + share * (rows[b, i, j] - rows[a, i, j])
                            sum_n += row * force[i]
                        for i in range(n):
                            sum_n += bias_q[a, j, i] * (y[i] - q[i])
                            sum_n += bias_v[a, j, i] * (y[n + i] - v[i])
                        general[j] = sum_n
                    for j in range(n):
                        acceleration = 0.0
                        for i in range(n):
                            inverse = mass_inverse[a, j, i]
                            inverse += share * (mass_inverse[b, j, i] - inverse)
                            acceleration += inverse * general[i]
                        dy[j] = y[n + j]
                        dy[n + j] = acceleration
                        if stage == 0:
                            twist[j] = acceleration
                        elif stage == 3:
                            twist[j] += acceleration
                        else:
                            twist[j] -= acceleration
                    if stage == 0:
                        if step == 0 and piece == 0 and pieces == 1:
                            for i in range(count):
                                heights[k, i] = z[i]
                                velocities[k, i] = w[i]
                                along_strut = 0.0
                                for j in range(n):
                                    along_strut += rows[a, i, j] * dy[n + j]
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
                piece += 1
                if pieces < _MOST_PIECES:
                    worst = 0.0
                    largest = 0.0
                    for j in range(n):
                        worst = max(worst, abs(twist[j]))
                        largest = max(largest, abs(dy[n + j]), abs(total[n + j]) / 5.0)
                    if worst * h * h > 6.0 * least and worst > bend * largest:
                        # A contact closed or friction turned within the step: again, in parts.
                        for i in range(size):
                            x[i] = began[i]
                        pieces = _PIECES if pieces == 1 else _MOST_PIECES
                        piece = 0
        if not abs(z[0]) < 1e3 * stroke + 1e3 * abs(heights0[0, 0]):
            return False
    return True


_MECHANISM = (_CUBE, _MATRIX, _CUBE, _CUBE, _CUBE, _MATRIX, _MATRIX, _MATRIX, _MATRIX)
_RUN = (_VECTOR, _VECTOR, _VECTOR, _I8, _F8, _F8, _VECTOR, _MATRIX, _MATRIX, _MATRIX)

_march = compile_loop(
    _march,
    types.boolean(
        _TEN_FORCES, _TEN_RATES, *(_TEN_POINTERS,) * 4,
        _VECTOR, _VECTOR, _INDEX, _MATRIX, *_MECHANISM, *_RUN,
    ),
)  # fmt: skip


def _simulate(
    forces: Any, rates: Any,
    index: Integers, p: Array, struts: Array,
    mass_inverse: Cube, bias: Array, bias_q: Cube, bias_v: Cube, rows: Cube, heights0: Array,
    applied: Array, q0: Array, v0: Array,
    t: Array, fine: Array, temperature: Array, substeps: int, bend: float, stroke: float,
    start: Array, heights: Array, velocities: Array, accelerations: Array,
) -> bool:  # fmt: skip
    # Pointers hold nothing: what they lead to is held by this function or by its caller.
    y = start.copy()
    dy = np.zeros(start.shape[0])
    states = np.zeros(SLOTS, dtype=np.int64)
    parameters = np.zeros(SLOTS, dtype=np.int64)
    strut = np.zeros(SLOTS, dtype=np.int64)
    for slot in range(index.shape[0]):
        states[slot] = 2 * rows.shape[2] + index[slot, 3]
        parameters[slot] = index[slot, 1]
        strut[slot] = index[slot, 0] * struts.shape[1]
    return _march(
        _ten(forces), _ten(rates), _pointers(y, states), _pointers(dy, states),
        _pointers(p, parameters), _pointers(struts.ravel(), strut),
        y, dy, index, struts,
        mass_inverse, bias, bias_q, bias_v, rows, heights0, applied, q0, v0,
        t, fine, temperature, substeps, bend, stroke, start, heights, velocities, accelerations,
    )  # fmt: skip


simulate = compile_loop(
    _simulate,
    types.boolean(_FORCES, _RATES, _INDEX, _VECTOR, _MATRIX, *_MECHANISM, *_RUN),
)
"""Free-run simulation.

Args: forces, rates and index of the slots; parameters; strut constants (struts, 5), the last one a
preload; then the mechanism, constant (K = 1) or tabulated at the nodes (K = N): inverse mass matrix
(K, n, n), bias force (K, n), its derivatives by coordinates and velocities (K, n, n), Jacobian of
the struts (K, struts, n), heights (K, struts), generalised force per applied newton (K, n),
coordinates and velocities to which these belong (K, n); times of the nodes (N,), applied force at
half sub-steps (2 * substeps * (N - 1) + 1,), temperature (N,), sub-steps, share by which a smooth
acceleration bends within one, stroke, start (2 n + states,); heights, velocities and accelerations
of the struts (N, struts), written. Returns whether the motion stayed finite.
"""


def _along(
    forces: Any, rates: Any, p: Array, strut: Array, t: Array, z: Array, w: Array,
    applied: Array, temperature: Array, substeps: int, start: Array, out: Array,
) -> None:  # fmt: skip
    force = forces[0]
    rate = rates[0]
    size = start.shape[0]
    s = start.copy()
    y = np.empty(size)
    k1 = np.zeros(size)
    k2 = np.zeros(size)
    s_at, y_at = _pointer(s, 0), _pointer(y, 0)
    k1_at, k2_at = _pointer(k1, 0), _pointer(k2, 0)
    p_at, strut_at = _pointer(p, 0), _pointer(strut, 0)
    for k in range(t.shape[0]):
        out[k] = force(t[k], z[k], w[k], applied[k], temperature[k], s_at, p_at, strut_at)
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
                temperature[k], s_at, p_at, strut_at, k1_at,
            )  # fmt: skip
            for i in range(size):
                y[i] = s[i] + 0.5 * h * k1[i]
            rate(
                t[k] + b * h, z[k] + b * dz, w[k] + b * dw, applied[k] + b * da,
                temperature[k], y_at, p_at, strut_at, k2_at,
            )  # fmt: skip
            for i in range(size):
                s[i] += h * k2[i]


along = compile_loop(
    _along,
    types.void(
        _FORCES, _RATES, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _VECTOR, _I8,
        _VECTOR, _VECTOR,
    ),
)  # fmt: skip
"""Force of one law along a known motion: its force and rate, each a list of one, parameters, strut
constants (4,), then times, heights, velocities, applied force and temperature (N,), sub-steps for
the internal state, its start; force, written.
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
