"""The catalogue's laws as machine code, and the loops that run them over whole logs.

The very functions that the plant calls tick by tick are compiled here with one signature each, so
that the loops below take them as values (numba's first-class functions) and are compiled once for
all effects.

Reference: Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I (1993), II.1, for the
classical Runge-Kutta method.
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
_Arrays = tuple[Array, ...]

_P = ParamSpec("_P")
_R = TypeVar("_R")

SLOTS = 10
"""Most effects that a simulation carries: the loops know their number when they are compiled."""

_F8 = types.float64
_I8 = types.int64
_VECTOR = types.Array(types.float64, 1, "C")
_MATRIX = types.Array(types.float64, 2, "C")
_CUBE = types.Array(types.float64, 3, "C")
_INTEGERS = types.Array(types.int64, 1, "C")
_POINTER = types.CPointer(types.float64)
_FORCE_SIGNATURE = _F8(*(_F8,) * 5, *(_POINTER,) * 3)
_RATE_SIGNATURE = types.void(*(_F8,) * 5, *(_POINTER,) * 4)
_FORCE = types.FunctionType(_FORCE_SIGNATURE)
_RATE = types.FunctionType(_RATE_SIGNATURE)
_FORCES = types.ListType(_FORCE)
_RATES = types.ListType(_RATE)
_TEN_FORCES = types.UniTuple(_FORCE, SLOTS)
_TEN_RATES = types.UniTuple(_RATE, SLOTS)
_TEN_POINTERS = types.UniTuple(_POINTER, SLOTS)


class Laws(NamedTuple):
    """Laws as machine code."""

    forces: Forces
    rates: Rates


def compile_loop(
    function: Callable[_P, _R], signature: Signature | list[Signature]
) -> Callable[_P, _R]:
    """A function as machine code for one signature, kept on disk, without the global lock."""
    return numba.njit(signature, cache=True, error_model="numpy", nogil=True)(function)


def _inline(function: Callable[_P, _R]) -> Callable[_P, _R]:
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
def _force(name: str) -> ForceOverArrays:
    return _compile_law(force_over_arrays(effect(name)), _FORCE_SIGNATURE)


@functools.cache
def _rate(name: str) -> RatesOverArrays:
    return _compile_law(rates_over_arrays(effect(name)), _RATE_SIGNATURE)


def _empty() -> tuple[Forces, Rates]:
    return typed.List.empty_list(_FORCE), typed.List.empty_list(_RATE)


def _append(forces: Forces, rates: Rates, force: ForceOverArrays, rate: RatesOverArrays) -> None:
    forces.append(force)
    rates.append(rate)


_empty = compile_loop(_empty, types.Tuple((_FORCES, _RATES))())
_append = compile_loop(_append, types.void(_FORCES, _RATES, _FORCE, _RATE))


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
    return Slots(_laws(names), placement, tuple(each), state)


def _ten(f: Sequence[_R]) -> tuple[_R, ...]:
    return f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8], f[9]


with warnings.catch_warnings():
    # While numba compiles this, not once it is on disk, it warns that functions as values are new.
    warnings.simplefilter("ignore", NumbaExperimentalFeatureWarning)
    _ten = compile_loop(_ten, [_TEN_FORCES(_FORCES), _TEN_RATES(_RATES)])


def _ctypes_of(array: Array, first: int) -> object:
    return array[first:].ctypes


def _ten_ctypes_of(a: Array, at: Integers) -> object:
    return (
        a[at[0] :].ctypes, a[at[1] :].ctypes, a[at[2] :].ctypes, a[at[3] :].ctypes,
        a[at[4] :].ctypes, a[at[5] :].ctypes, a[at[6] :].ctypes, a[at[7] :].ctypes,
        a[at[8] :].ctypes, a[at[9] :].ctypes,
    )  # fmt: skip


# An array's `ctypes` becomes a bare pointer only where a signature asks for one.
_pointer = cast(
    "Callable[[Array, int], Writable]", compile_loop(_ctypes_of, _POINTER(_VECTOR, _I8))
)
_pointers = cast(
    "Callable[[Array, Integers], tuple[Writable, ...]]",
    compile_loop(_ten_ctypes_of, _TEN_POINTERS(_VECTOR, _INTEGERS)),
)


class Equations(NamedTuple):
    """Equations of motion without the struts' forces: constant (K = 1) or at the nodes (K = N).

    Attributes:
        mass_inverse: Inverse mass matrix, shape (K, n, n).
        bias: Generalised force of all but struts and inputs, shape (K, n).
        bias_q: Its derivative by the coordinates, shape (K, n, n).
        bias_v: Its derivative by their rates, shape (K, n, n).
        jacobian: Jacobian of the struts, shape (K, struts, n).
        heights_m: Strut heights, shape (K, struts).
        rates_m_per_s: Their rates, shape (K, struts).
        inputs: Generalised force per unit of each input, shape (K, n, inputs).
        q: Coordinates to which these belong, shape (K, n).
        v: Their rates, shape (K, n).
    """

    mass_inverse: Array
    bias: Array
    bias_q: Array
    bias_v: Array
    jacobian: Array
    heights_m: Array
    rates_m_per_s: Array
    inputs: Array
    q: Array
    v: Array


class Scenario(NamedTuple):
    """Where a simulation begins, and what drives it.

    Attributes:
        start: Coordinates, their rates and internal states, shape (2 n + states,).
        t_s: Times of the nodes, shape (N,).
        applied_n: Applied force of laws at half sub-steps, shape (2 * substeps * (N - 1) + 1,).
        temperature_c: Temperature at the nodes, shape (N,).
        inputs: Input vector at half sub-steps, shape (as above, inputs).
        moved: What moved bodies add to heights and to their rates at half sub-steps, shape (as
            above, 2, struts); empty where no body is moved.
    """

    start: Array
    t_s: Array
    applied_n: Array
    temperature_c: Array
    inputs: Array
    moved: Array


class Steps(NamedTuple):
    """How finely a simulation steps; `bend`: share by which a smooth acceleration bends in one."""

    substeps: int
    bend: float
    stroke_m: float


class Trajectory(NamedTuple):
    """Strut motions at the nodes, each of shape (N, struts)."""

    heights_m: Array
    velocities_m_per_s: Array
    accelerations_m_per_s2: Array


class Model(NamedTuple):
    """A model as it is simulated.

    Attributes:
        struts: Constants of the struts, shape (struts, 5): free length, stiffness,
            damping, gravity and preload.
    """

    placement: Placement
    parameters: Array
    struts: Array
    equations: Equations


class _Span(NamedTuple):
    """A step of the integrator between two nodes, and what drives it.

    Attributes:
        before: Index of the node before in the equations' tables.
        fine: Indices of the beginning, the middle and the end of the step in the scenario's.
        applied_n: Applied force there.
        warming_k: Change of the temperature from node to node.
    """

    before: int
    after: int
    gap_s: float
    first_s: float
    step_s: float
    step: int
    steps: int
    fine: tuple[int, int, int]
    applied_n: tuple[float, float, float]
    temperature_c: float
    warming_k: float


class _Work(NamedTuple):
    """What an evaluation of the slope at `x` (2 n + states,) leaves behind, `general` in (n,)."""

    inputs: Array
    x: Array
    slope: Array
    q: Array
    v: Array
    general: Array
    heights_m: Array
    velocities: Array
    forces_n: Array


class _Step(NamedTuple):
    """Sums of a Runge-Kutta step at `x`; `twist`: second difference of the accelerations (n,)."""

    x: Array
    began: Array
    total: Array
    twist: Array


class _Calls(NamedTuple):
    """The laws of a simulation with pointers to what each reads and writes, `SLOTS` of each."""

    forces: tuple[ForceOverArrays, ...]
    rates: tuple[RatesOverArrays, ...]
    states: tuple[Writable, ...]
    slopes: tuple[Writable, ...]
    parameters: tuple[Writable, ...]
    struts: tuple[Writable, ...]


class _Instant(NamedTuple):
    """A time between two nodes, `share` of the gap after the first.

    Attributes:
        weights: Of the beginning, the middle and the end of a step, in what drives it: a parabola.
    """

    before: int
    after: int
    gap_s: float
    share: float
    t_s: float
    fine: tuple[int, int, int]
    weights: tuple[float, float, float]
    applied_n: float
    temperature_c: float


_PIECES = 8
"""Parts into which a step is cut where a force jumps."""
_MOST_PIECES = 32
"""The same where it jumps within one of these, as friction does that is all but a sign."""
_LARGEST_ERROR = 5e-8
"""Change of height within a step by a jump of force, as a share of the stroke, from which on the
step is cut: a tenth of the resolution of usual height sensors over their range."""

FREE_LENGTH, STIFFNESS, DAMPING, GRAVITY, PRELOAD = range(5)
"""Columns of a strut's constants."""


@_inline
def _span(scenario: Scenario, substeps: int, node: int, step: int, tabulated: bool) -> _Span:
    t, fine, temperature = scenario.t_s, scenario.applied_n, scenario.temperature_c
    after = min(node + 1, t.shape[0] - 1)
    gap = t[after] - t[node]
    last = fine.shape[0] - 1
    at = min(2 * (substeps * node + step), last)
    return _Span(
        node if tabulated else 0,
        after if tabulated else 0,
        gap,
        t[node],
        gap / substeps,
        step,
        substeps,
        (at, min(at + 1, last), min(at + 2, last)),
        (fine[at], fine[min(at + 1, last)], fine[min(at + 2, last)]),
        temperature[node],
        temperature[after] - temperature[node],
    )


@_inline
def _instant(span: _Span, u: float) -> _Instant:
    """The time at a share `u` of a step; what drives it is a parabola over it."""
    f0, f1, f2 = span.applied_n
    share = (span.step + u) / span.steps
    weights = ((1.0 - u) * (1.0 - 2.0 * u), 4.0 * u * (1.0 - u), u * (2.0 * u - 1.0))
    return _Instant(
        span.before,
        span.after,
        span.gap_s,
        share,
        span.first_s + (span.step + u) * span.step_s,
        span.fine,
        weights,
        f0 * weights[0] + f1 * weights[1] + f2 * weights[2],
        span.temperature_c + share * span.warming_k,
    )


@_inline
def _cubic(rise: float, early: float, late: float, share: float) -> float:
    """Change since a node by Hermite's cubic: of a rise with slopes times the gap at both ends."""
    turn = early + late - 2.0 * rise
    sag = 3.0 * rise - 2.0 * early - late
    return share * (early + share * (sag + share * turn))


@_inline
def _follow_reference(equations: Equations, at: _Instant, work: _Work) -> None:
    """Write the reference coordinates and their rates, between nodes."""
    # Hermite's cubic: a chord would cut the motion's bends.
    q, v, a, b = equations.q, equations.v, at.before, at.after
    for j in range(q.shape[1]):
        rise = q[b, j] - q[a, j]
        early = at.gap_s * v[a, j]
        late = at.gap_s * v[b, j]
        work.q[j] = q[a, j] + _cubic(rise, early, late, at.share)
        work.v[j] = v[a, j]
        if at.gap_s > 0.0:
            turn = early + late - 2.0 * rise
            sag = 3.0 * rise - 2.0 * early - late
            rate = early + at.share * (2.0 * sag + 3.0 * at.share * turn)
            work.v[j] = rate / at.gap_s


@_inline
def _write_inputs(inputs: Array, at: _Instant, work: _Work) -> None:
    """Write the input vector."""
    (a, b, c), (early, middle, late) = at.fine, at.weights
    for k in range(inputs.shape[1]):
        work.inputs[k] = early * inputs[a, k] + middle * inputs[b, k] + late * inputs[c, k]


@_inline
def _add_moved(moved: Array, at: _Instant, work: _Work) -> None:
    """Add what moved bodies do to heights and velocities."""
    (a, b, c), (early, middle, late) = at.fine, at.weights
    for i in range(moved.shape[2]):
        work.heights_m[i] += (
            early * moved[a, 0, i] + middle * moved[b, 0, i] + late * moved[c, 0, i]
        )
        work.velocities[i] += (
            early * moved[a, 1, i] + middle * moved[b, 1, i] + late * moved[c, 1, i]
        )


@_inline
def _move_struts(equations: Equations, at: _Instant, work: _Work, tabulated: bool) -> None:
    """Write the struts' heights and velocities, but for what moved bodies add to them."""
    rows, heights, a, b = equations.jacobian, equations.heights_m, at.before, at.after
    n = rows.shape[2]
    for i in range(rows.shape[1]):
        height = heights[a, i]
        if tabulated:
            # Heights follow the reference by a cubic, and to first order in the distance from it.
            early = at.gap_s * equations.rates_m_per_s[a, i]
            late = at.gap_s * equations.rates_m_per_s[b, i]
            height += _cubic(heights[b, i] - heights[a, i], early, late, at.share)
        velocity = 0.0
        for j in range(n):
            row = rows[a, i, j] + at.share * (rows[b, i, j] - rows[a, i, j])
            height += row * (work.x[j] - work.q[j])
            velocity += row * work.x[n + j]
        work.heights_m[i] = height
        work.velocities[i] = velocity


@_inline
def _write_linear_forces(struts: Array, work: _Work) -> None:
    """Write the forces of the struts' springs and dampers."""
    for i in range(struts.shape[0]):
        work.forces_n[i] = (
            struts[i, PRELOAD]
            - struts[i, STIFFNESS] * (work.heights_m[i] - struts[i, FREE_LENGTH])
            - struts[i, DAMPING] * work.velocities[i]
        )


@_inline
def _add_effects(placement: Placement, calls: _Calls, at: _Instant, work: _Work) -> None:
    """Add the forces of the effects, and write the rates of their internal states."""
    for slot in range(SLOTS):
        # A fixed number of turns is unrolled, so that no tuple is searched.
        if slot >= placement.struts.shape[0]:
            break
        i: int = placement.struts[slot]
        if placement.first_states[slot] >= 0:
            calls.rates[slot](
                at.t_s, work.heights_m[i], work.velocities[i], at.applied_n, at.temperature_c,
                calls.states[slot], calls.parameters[slot], calls.struts[slot], calls.slopes[slot],
            )  # fmt: skip
        work.forces_n[i] += calls.forces[slot](
            at.t_s, work.heights_m[i], work.velocities[i], at.applied_n, at.temperature_c,
            calls.states[slot], calls.parameters[slot], calls.struts[slot],
        )  # fmt: skip


@_inline
def _accelerate(equations: Equations, at: _Instant, work: _Work) -> None:
    """Write the slope of coordinates and rates."""
    rows, a, b, share = equations.jacobian, at.before, at.after, at.share
    bias, columns, inverses = equations.bias, equations.inputs, equations.mass_inverse
    n = rows.shape[2]
    for j in range(n):
        sum_n = bias[a, j] + share * (bias[b, j] - bias[a, j])
        for i in range(columns.shape[2]):
            column = columns[a, j, i] + share * (columns[b, j, i] - columns[a, j, i])
            sum_n += column * work.inputs[i]
        for i in range(rows.shape[1]):
            row = rows[a, i, j] + share * (rows[b, i, j] - rows[a, i, j])
            sum_n += row * work.forces_n[i]
        for i in range(n):
            sum_n += equations.bias_q[a, j, i] * (work.x[i] - work.q[i])
            sum_n += equations.bias_v[a, j, i] * (work.x[n + i] - work.v[i])
        work.general[j] = sum_n
    for j in range(n):
        acceleration = 0.0
        for i in range(n):
            inverse = inverses[a, j, i]
            inverse += share * (inverses[b, j, i] - inverse)
            acceleration += inverse * work.general[i]
        work.slope[j] = work.x[n + j]
        work.slope[n + j] = acceleration


@_inline
def _write_slope(
    model: Model, calls: _Calls, scenario: Scenario, at: _Instant, work: _Work
) -> None:
    """Evaluate the differential equation at `work.x`."""
    tabulated = model.equations.jacobian.shape[0] > 1
    if tabulated:
        _follow_reference(model.equations, at, work)
    _write_inputs(scenario.inputs, at, work)
    _move_struts(model.equations, at, work, tabulated)
    if scenario.moved.shape[0] > 0:
        _add_moved(scenario.moved, at, work)
    _write_linear_forces(model.struts, work)
    _add_effects(model.placement, calls, at, work)
    _accelerate(model.equations, at, work)


@_inline
def _begin_stage(stage: int, h: float, step: _Step, work: _Work) -> None:
    """Write where a stage of the classical Runge-Kutta method evaluates the slope."""
    if stage == 0:
        for i in range(step.x.shape[0]):
            work.x[i] = step.x[i]
    else:
        reach = h if stage == 3 else 0.5 * h
        for i in range(step.x.shape[0]):
            work.x[i] = step.x[i] + reach * work.slope[i]


@_inline
def _end_stage(stage: int, h: float, step: _Step, work: _Work) -> None:
    """Add a stage's slope with its weight: 1, 2, 2, 1; the last one ends the step."""
    n, size = step.twist.shape[0], step.x.shape[0]
    if stage == 0:
        for j in range(n):
            step.twist[j] = work.slope[n + j]
        for i in range(size):
            step.total[i] = work.slope[i]
    elif stage == 3:
        for j in range(n):
            step.twist[j] += work.slope[n + j]
        for i in range(size):
            step.x[i] += h / 6.0 * (step.total[i] + work.slope[i])
    else:
        for j in range(n):
            step.twist[j] -= work.slope[n + j]
        for i in range(size):
            step.total[i] += 2.0 * work.slope[i]


@_inline
def _has_jump(h: float, steps: Steps, step: _Step, work: _Work) -> bool:
    """Whether a force jumped within a step, as it does where a contact closes or friction turns."""
    n = step.twist.shape[0]
    worst = 0.0
    largest = 0.0
    for j in range(n):
        worst = max(worst, abs(step.twist[j]))
        largest = max(largest, abs(work.slope[n + j]), abs(step.total[n + j]) / 5.0)
    least = _LARGEST_ERROR * steps.stroke_m
    return bool(worst * h * h > 6.0 * least and worst > steps.bend * largest)


@_inline
def _record(equations: Equations, node: int, work: _Work, out: Trajectory) -> None:
    """Write the motion at a node."""
    rows = equations.jacobian
    a = node if rows.shape[0] > 1 else 0
    n = rows.shape[2]
    for i in range(rows.shape[1]):
        out.heights_m[node, i] = work.heights_m[i]
        out.velocities_m_per_s[node, i] = work.velocities[i]
        along_strut = 0.0
        for j in range(n):
            along_strut += rows[a, i, j] * work.slope[n + j]
        out.accelerations_m_per_s2[node, i] = along_strut


@_inline
def _march(
    model: Model, calls: _Calls, scenario: Scenario, steps: Steps, work: _Work, step: _Step,
    out: Trajectory,
) -> bool:  # fmt: skip
    # Laws take bare pointers, because an array would be counted as held and released at each call.
    # The pointers come as arguments: numba has no arithmetic to make them of others in the loop,
    # and to cut an array there for each call takes longer than most laws.
    tabulated = model.equations.jacobian.shape[0] > 1
    farthest_m = 1e3 * steps.stroke_m + 1e3 * abs(model.equations.heights_m[0, 0])
    nodes = scenario.t_s.shape[0]
    for node in range(nodes):
        for substep in range(steps.substeps):
            span = _span(scenario, steps.substeps, node, substep, tabulated)
            for i in range(step.x.shape[0]):
                step.began[i] = step.x[i]
            pieces = 1
            piece = 0
            while piece < pieces:
                h = span.step_s / pieces
                for stage in range(4):
                    # Nodes of the classical Runge-Kutta method: 0, 1/2, 1/2, 1.
                    u = (piece + 0.5 * ((stage + 1) // 2)) / pieces
                    _begin_stage(stage, h, step, work)
                    _write_slope(model, calls, scenario, _instant(span, u), work)
                    if stage == 0 and substep == 0 and piece == 0 and pieces == 1:
                        _record(model.equations, node, work, out)
                        if node + 1 == nodes:
                            return True
                    _end_stage(stage, h, step, work)
                piece += 1
                if pieces < _MOST_PIECES and _has_jump(h, steps, step, work):
                    # Again, in parts.
                    for i in range(step.x.shape[0]):
                        step.x[i] = step.began[i]
                    pieces = _PIECES if pieces == 1 else _MOST_PIECES
                    piece = 0
        if not abs(work.heights_m[0]) < farthest_m:
            return False
    return True


# Signatures of what is kept on disk hold plain tuples: numba's index of it names the classes of
# a signature, and could not be read after one of them was renamed.
_PLACEMENT = types.UniTuple(_INTEGERS, 3)
_EQUATIONS = types.Tuple(
    (_CUBE, _MATRIX, _CUBE, _CUBE, _CUBE, _MATRIX, _MATRIX, _CUBE, _MATRIX, _MATRIX)
)
_MODEL = types.Tuple((_PLACEMENT, _VECTOR, _MATRIX, _EQUATIONS))
_SCENARIO = types.Tuple((*(_VECTOR,) * 4, _MATRIX, _CUBE))
_STEPS = types.Tuple((_I8, _F8, _F8))
_TRAJECTORY = types.UniTuple(_MATRIX, 3)


def _simulate(
    forces: Forces,
    rates: Rates,
    model_parts: tuple[tuple[Integers, ...], Array, Array, _Arrays],
    scenario_parts: _Arrays,
    steps: tuple[int, float, float],
    out: _Arrays,
) -> bool:
    # Pointers hold nothing: what they lead to is held by this function or by its caller.
    placement, equations = Placement(*model_parts[0]), Equations(*model_parts[3])
    model = Model(placement, model_parts[1], model_parts[2], equations)
    scenario = Scenario(*scenario_parts)
    start, struts = scenario.start, model.struts
    size = start.shape[0]
    count, n = equations.jacobian.shape[1:]
    states = np.zeros(SLOTS, dtype=np.int64)
    parameters = np.zeros(SLOTS, dtype=np.int64)
    strut = np.zeros(SLOTS, dtype=np.int64)
    for slot in range(placement.struts.shape[0]):
        states[slot] = 2 * n + max(placement.first_states[slot], 0)
        parameters[slot] = placement.first_parameters[slot]
        strut[slot] = placement.struts[slot] * struts.shape[1]
    work = _Work(
        np.zeros(equations.inputs.shape[2]), start.copy(), np.zeros(size),
        equations.q[0].copy(), equations.v[0].copy(),
        np.zeros(n), np.zeros(count), np.zeros(count), np.zeros(count),
    )  # fmt: skip
    calls = _Calls(
        _ten(forces), _ten(rates),
        _pointers(work.x, states), _pointers(work.slope, states),
        _pointers(model.parameters, parameters), _pointers(struts.ravel(), strut),
    )  # fmt: skip
    step = _Step(start.copy(), start.copy(), np.zeros(size), np.zeros(n))
    return _march(model, calls, scenario, Steps(*steps), work, step, Trajectory(*out))


_simulate = compile_loop(
    _simulate, types.boolean(_FORCES, _RATES, _MODEL, _SCENARIO, _STEPS, _TRAJECTORY)
)


def simulate(laws: Laws, model: Model, scenario: Scenario, steps: Steps, out: Trajectory) -> bool:
    """Free-run simulation, written to `out`, by the classical Runge-Kutta method.

    Returns:
        Whether the motion stayed finite.
    """
    parts = (tuple(model.placement), model.parameters, model.struts, tuple(model.equations))
    return _simulate(*laws, parts, tuple(scenario), steps[:], tuple(out))


def _along(
    forces: Forces, rates: Rates, values: _Arrays, motion: _Arrays, substeps: int, out: Array
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
    s_at, y_at = _pointer(s, 0), _pointer(y, 0)
    k1_at, k2_at = _pointer(k1, 0), _pointer(k2, 0)
    p_at, strut_at = _pointer(parameters, 0), _pointer(strut, 0)
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


_VALUES = types.UniTuple(_VECTOR, 3)
_MOTION = types.UniTuple(_VECTOR, 5)
_along = compile_loop(_along, types.void(_FORCES, _RATES, _VALUES, _MOTION, _I8, _VECTOR))


def force_along(name: str, values: _Arrays, motion: _Arrays, substeps: int) -> Array:
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
