"""The catalogue's laws as machine code, with their derivatives, and their forces over whole logs.

The very functions that the plant calls tick by tick are compiled here with one signature each, so
that loops take them as values (numba's first-class functions) and are compiled once for all
effects.
"""

import functools
import warnings
from collections.abc import Callable, MutableSequence, Sequence
from typing import NamedTuple, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.calling import (
    ForceOverArrays,
    RatesOverArrays,
    force_over_arrays,
    rates_over_arrays,
)
from dart_model.effects.law import Writable
from dart_model.effects.slopes import SlopesOverArrays, force_slopes, rate_slopes
from rig.files.numba_alone import (
    NumbaExperimentalFeatureWarning,
    Signature,
    numba,
    typed,
    types,
)

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Forces = MutableSequence[ForceOverArrays]
Rates = MutableSequence[RatesOverArrays]
Arrays = tuple[Array, ...]

_P = ParamSpec("_P")
_R = TypeVar("_R")

SLOTS = 10
"""Most effects that a simulation carries: the loops know their number when they are compiled."""

F8 = types.float64
I8 = types.int64
VECTOR = types.Array(types.float64, 1, "C")
MATRIX = types.Array(types.float64, 2, "C")
CUBE = types.Array(types.float64, 3, "C")
INTEGERS = types.Array(types.int64, 1, "C")
_POINTER = types.CPointer(types.float64)
_FORCE_SIGNATURE = F8(*(F8,) * 5, *(_POINTER,) * 3)
_RATE_SIGNATURE = types.void(*(F8,) * 5, *(_POINTER,) * 4)
_FORCE = types.FunctionType(_FORCE_SIGNATURE)
_RATE = types.FunctionType(_RATE_SIGNATURE)
FORCES = types.ListType(_FORCE)
RATES = types.ListType(_RATE)
_TEN_FORCES = types.UniTuple(_FORCE, SLOTS)
_TEN_RATES = types.UniTuple(_RATE, SLOTS)
_TEN_POINTERS = types.UniTuple(_POINTER, SLOTS)


class Laws(NamedTuple):
    """Laws as machine code."""

    forces: Forces
    rates: Rates


class LawSlopes(NamedTuple):
    """Derivatives of laws as machine code."""

    forces: Rates
    rates: Rates


def compile_loop(
    function: Callable[_P, _R], signature: Signature | list[Signature]
) -> Callable[_P, _R]:
    """A function as machine code for one signature, kept on disk, without the global lock."""
    return numba.njit(signature, cache=True, error_model="numpy", nogil=True)(function)


def inline(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """A part of a loop: compiled with the loop that calls it, and never on its own.

    It allocates nothing, and counts no references: an array would be held and released at each
    call, and so would every array of a structure.
    """
    # numba's types have no name for the last three options.
    compiler = cast("Callable[..., Callable[[Callable[_P, _R]], Callable[_P, _R]]]", numba.njit)
    return compiler(
        error_model="numpy",
        forceinline=True,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
        _nrt=False,
    )(function)


def _compile_law(function: Callable[_P, _R], signature: Signature) -> Callable[_P, _R]:
    # A law only reads and writes by index, so bare pointers do, which cost least in a call.
    return numba.cfunc(signature, cache=True, error_model="numpy")(function)


# The lists of laws hold addresses, not references: the caches keep the machine code.
@functools.cache
def _force_slopes(name: str) -> SlopesOverArrays:
    return _compile_law(force_slopes(effect(name)), _RATE_SIGNATURE)


@functools.cache
def _rate_slopes(name: str) -> SlopesOverArrays:
    return _compile_law(rate_slopes(effect(name)), _RATE_SIGNATURE)


@functools.cache
def _slopes(names: tuple[str, ...]) -> "LawSlopes":
    """Derivatives of laws as machine code."""
    forces, rates = typed.List.empty_list(_RATE), typed.List.empty_list(_RATE)
    for name in names:
        _append(
            forces,
            rates,
            _force_slopes(name),
            _rate_slopes(name if effect(name).rate else "none"),
        )
    return LawSlopes(forces, rates)


@functools.cache
def _force(name: str) -> ForceOverArrays:
    return _compile_law(force_over_arrays(effect(name)), _FORCE_SIGNATURE)


@functools.cache
def _rate(name: str) -> RatesOverArrays:
    return _compile_law(rates_over_arrays(effect(name)), _RATE_SIGNATURE)


def _empty() -> tuple[Forces, Rates]:
    return typed.List.empty_list(_FORCE), typed.List.empty_list(_RATE)


def _append(forces: MutableSequence[_R], rates: Rates, force: _R, rate: RatesOverArrays) -> None:
    forces.append(force)
    rates.append(rate)


_empty = compile_loop(_empty, types.Tuple((FORCES, RATES))())
_append = compile_loop(
    _append,
    [types.void(FORCES, RATES, _FORCE, _RATE), types.void(RATES, RATES, _RATE, _RATE)],
)


@functools.cache
def _laws(names: tuple[str, ...]) -> Laws:
    # The interpreter is asked for a function's address once, here; it would be at every call of a
    # loop that took functions themselves, for longer than a short loop runs. They are appended one
    # by one, because numba warns of a tuple of functions, and a thread cannot silence warnings
    # without silencing other threads'.
    forces, rates = _empty()
    for name in names:
        _append(forces, rates, _force(name), _rate(name if effect(name).rate else "none"))
    return Laws(forces, rates)


def compile_law(name: str) -> None:
    """Compile the law of an effect, before threads need it: numba's compiler admits one."""
    _laws((name,))


NO_SLOPES = _slopes(("none",) * SLOTS)
"""Derivatives for a simulation that takes none."""


class Slot(NamedTuple):
    """Where a placed effect reads its values: its part of all parameters and internal states."""

    strut: int
    parameters: slice
    states: slice


class Placement(NamedTuple):
    """Indices (effects,) of strut, first parameter and first internal state (-1 if it has none)."""

    struts: Integers
    first_parameters: Integers
    first_states: Integers


class Slots(NamedTuple):
    """Effects in the struts of a model; its laws are filled up to `SLOTS`."""

    laws: Laws
    placement: Placement
    each: tuple[Slot, ...]
    states: int
    names: tuple[str, ...]

    @property
    def slopes(self) -> LawSlopes:
        """Derivatives of the laws."""
        return _slopes(self.names)

    def compile_slopes(self) -> None:
        """Compile the derivatives of the laws, before threads need them."""
        _slopes(self.names)

    @property
    def sizes(self) -> Integers:
        """Internal states and parameters of each effect, shape (effects, 2)."""
        sizes = [
            (s.states.stop - s.states.start, s.parameters.stop - s.parameters.start)
            for s in self.each
        ]
        return np.array(sizes, np.int64).reshape(len(sizes), 2)


@functools.lru_cache(maxsize=4096)
def slots(effects: tuple[tuple[int, str], ...]) -> Slots:
    """Slots for effects, each given by its strut and name.

    Raises:
        ValueError: There are more than `SLOTS`.
    """
    if len(effects) > SLOTS:
        raise ValueError(f"{len(effects)} effects in one simulation, which carries at most {SLOTS}")
    each: list[Slot] = []
    parameter = state = 0
    for strut, name in effects:
        item = effect(name)
        past_parameter, past_state = parameter + len(item.parameters), state + item.state_size
        each.append(Slot(strut, slice(parameter, past_parameter), slice(state, past_state)))
        parameter, state = past_parameter, past_state
    names = tuple(name for _, name in effects) + ("none",) * (SLOTS - len(effects))
    placement = Placement(
        np.array([slot.strut for slot in each], np.int64),
        np.array([slot.parameters.start for slot in each], np.int64),
        np.array(
            [s.states.start if s.states.stop > s.states.start else -1 for s in each], np.int64
        ),
    )
    return Slots(_laws(names), placement, tuple(each), state, names)


def ten(f: Sequence[_R]) -> tuple[_R, ...]:
    """As many laws as a simulation carries, of a list."""
    return f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9]


with warnings.catch_warnings():
    # While numba compiles this, not once it is on disk, it warns that functions as values are new.
    warnings.simplefilter("ignore", NumbaExperimentalFeatureWarning)
    ten = compile_loop(ten, [_TEN_FORCES(FORCES), _TEN_RATES(RATES)])


def _ctypes_of(array: Array, first: int) -> object:
    return array[first:].ctypes


def _ten_ctypes_of(a: Array, at: Integers) -> object:
    return (
        a[at[0] :].ctypes, a[at[1] :].ctypes, a[at[2] :].ctypes, a[at[3] :].ctypes,
        a[at[4] :].ctypes, a[at[5] :].ctypes, a[at[6] :].ctypes, a[at[7] :].ctypes,
        a[at[8] :].ctypes, a[at[9] :].ctypes,
    )  # fmt: skip


# An array's `ctypes` becomes a bare pointer only where a signature asks for one.
pointer = cast("Callable[[Array, int], Writable]", compile_loop(_ctypes_of, _POINTER(VECTOR, I8)))
pointers = cast(
    "Callable[[Array, Integers], tuple[Writable, ...]]",
    compile_loop(_ten_ctypes_of, _TEN_POINTERS(VECTOR, INTEGERS)),
)


def _along(
    forces: Forces, rates: Rates, values: Arrays, motion: Arrays, substeps: int, out: Array
) -> None:
    force = forces[0]
    rate = rates[0]
    t, z, w, applied, temperature = motion
    parameters, strut, start = values
    size = start.shape[0]
    s = start.copy()
    y = np.empty(size)
    k1 = np.zeros(size)
    k2 = np.zeros(size)
    s_at, y_at = pointer(s, 0), pointer(y, 0)
    k1_at, k2_at = pointer(k1, 0), pointer(k2, 0)
    p_at, strut_at = pointer(parameters, 0), pointer(strut, 0)
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


_VALUES = types.UniTuple(VECTOR, 3)
_MOTION = types.UniTuple(VECTOR, 5)
_along = compile_loop(_along, types.void(FORCES, RATES, _VALUES, _MOTION, I8, VECTOR))


def force_along(name: str, values: Arrays, motion: Arrays, substeps: int) -> Array:
    """Force (N,) of the law of an effect along a known motion.

    Args:
        name: Name of the effect.
        values: Its parameters, constants of its strut, internal states at the beginning.
        motion: Times, heights, their rates, applied force and temperature, each of shape (N,).
        substeps: Steps of the internal states between two samples.
    """
    out = np.empty(len(motion[0]))
    _along(*_laws((name,)), values, motion, substeps, out)
    return out
