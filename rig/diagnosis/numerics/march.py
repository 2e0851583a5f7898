"""Free runs as machine code, with their derivatives by parameters and by where they begin.

The derivatives march along with the motion: each step of the classical Runge-Kutta method is
differentiated as it is taken, so that they are those of the motion as it is computed.

References:
    Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I (1993), II.1, for the
    method; I.14 for the derivatives.
    Maly, Petzold, Numerical methods and software for sensitivity analysis of differential-algebraic
    systems, Appl. Numer. Math. 20 (1996), for derivatives marched with the motion.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects.calling import ForceOverArrays, RatesOverArrays
from dart_model.effects.law import Writable
from dart_model.effects.slopes import SlopesOverArrays
from rig.diagnosis.numerics.laws import (
    CUBE,
    F8,
    FORCES,
    I8,
    INTEGERS,
    MATRIX,
    NO_SLOPES,
    RATES,
    SLOTS,
    VECTOR,
    Arrays,
    Forces,
    LawSlopes,
    Placement,
    Rates,
    Slots,
    compile_loop,
    inline,
    pointer,
    pointers,
    ten,
)
from rig.files.numba_alone import types

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


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
        strides: Nodes where a stride begins or ends, the first and the last among them, shape
            (S + 1,); each stride is taken in the same number of sub-steps.
        applied_n: Applied force of laws at half sub-steps, shape (2 * substeps * S + 1,).
        temperature_c: Temperature at the nodes, shape (N,).
        inputs: Input vector at half sub-steps, shape (as above, inputs).
        moved: What moved bodies add to heights and to their rates at half sub-steps, shape (as
            above, 2, struts); empty where no body is moved.
    """

    start: Array
    t_s: Array
    strides: Integers
    applied_n: Array
    temperature_c: Array
    inputs: Array
    moved: Array


class Steps(NamedTuple):
    """How finely a simulation steps.

    Attributes:
        bend: Share by which the force of a smooth law departs, within a step, from the parabola
            that it followed before.
        error_m: Change of height by a jump of force from which on a step is cut there.
    """

    substeps: int
    bend: float
    error_m: float
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
    effects_n: Array


class _Step(NamedTuple):
    """Sums of a Runge-Kutta step at `x`.

    Attributes:
        twist: Second difference of each effect's force, shape (effects,).
        largest: Largest size of that force.
        known: Second difference that the last step had, over the square of its length.
        answer: Acceleration of its strut by a newton.
    """

    x: Array
    began: Array
    total: Array
    twist: Array
    largest: Array
    known: Array
    answer: Array


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


_CUTS = 4
"""Parts into which a step, or a part of it, is cut where a force jumps."""
_PARTS = _CUTS**3
"""Most parts of a step: friction that is all but a sign takes such short ones."""

FREE_LENGTH, STIFFNESS, DAMPING, GRAVITY, PRELOAD = range(5)
"""Columns of a strut's constants."""


@inline
def _span(scenario: Scenario, substeps: int, stride: int, step: int, tabulated: bool) -> _Span:
    t, fine, temperature = scenario.t_s, scenario.applied_n, scenario.temperature_c
    node: int = scenario.strides[stride]
    after: int = scenario.strides[min(stride + 1, scenario.strides.shape[0] - 1)]
    gap = t[after] - t[node]
    last = fine.shape[0] - 1
    at = min(2 * (substeps * stride + step), last)
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


@inline
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


@inline
def _cubic(rise: float, early: float, late: float, share: float) -> float:
    """Change since a node by Hermite's cubic: of a rise with slopes times the gap at both ends."""
    turn = early + late - 2.0 * rise
    sag = 3.0 * rise - 2.0 * early - late
    return share * (early + share * (sag + share * turn))


@inline
def _cubic_rate(rise: float, early: float, late: float, share: float) -> float:
    """Derivative of that change by the share."""
    turn = early + late - 2.0 * rise
    sag = 3.0 * rise - 2.0 * early - late
    return early + share * (2.0 * sag + 3.0 * share * turn)


@inline
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
            work.v[j] = _cubic_rate(rise, early, late, at.share) / at.gap_s


@inline
def _write_inputs(inputs: Array, at: _Instant, work: _Work) -> None:
    """Write the input vector."""
    (a, b, c), (early, middle, late) = at.fine, at.weights
    for k in range(inputs.shape[1]):
        work.inputs[k] = early * inputs[a, k] + middle * inputs[b, k] + late * inputs[c, k]


@inline
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


@inline
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


@inline
def _write_linear_forces(struts: Array, work: _Work) -> None:
    """Write the forces of the struts' springs and dampers."""
    for i in range(struts.shape[0]):
        work.forces_n[i] = (
            struts[i, PRELOAD]
            - struts[i, STIFFNESS] * (work.heights_m[i] - struts[i, FREE_LENGTH])
            - struts[i, DAMPING] * work.velocities[i]
        )


@inline
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
        work.effects_n[slot] = calls.forces[slot](
            at.t_s, work.heights_m[i], work.velocities[i], at.applied_n, at.temperature_c,
            calls.states[slot], calls.parameters[slot], calls.struts[slot],
        )  # fmt: skip
        work.forces_n[i] += work.effects_n[slot]


@inline
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


@inline
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


@inline
def _begin_stage(stage: int, h: float, step: _Step, work: _Work) -> None:
    """Write where a stage of the classical Runge-Kutta method evaluates the slope."""
    if stage == 0:
        for i in range(step.x.shape[0]):
            work.x[i] = step.x[i]
    else:
        reach = h if stage == 3 else 0.5 * h
        for i in range(step.x.shape[0]):
            work.x[i] = step.x[i] + reach * work.slope[i]


@inline
def _end_stage(stage: int, h: float, step: _Step, work: _Work) -> None:
    """Add a stage's slope with its weight: 1, 2, 2, 1; the last one ends the step."""
    size, effects = step.x.shape[0], step.twist.shape[0]
    if stage == 0:
        for j in range(effects):
            step.twist[j] = work.effects_n[j]
            step.largest[j] = abs(work.effects_n[j])
        for i in range(size):
            step.total[i] = work.slope[i]
    elif stage == 3:
        for j in range(effects):
            step.twist[j] += work.effects_n[j]
            step.largest[j] = max(step.largest[j], abs(work.effects_n[j]))
        for i in range(size):
            step.x[i] += h / 6.0 * (step.total[i] + work.slope[i])
    else:
        for j in range(effects):
            step.twist[j] -= work.effects_n[j]
        for i in range(size):
            step.total[i] += 2.0 * work.slope[i]


@inline
def _has_jump(h: float, steps: Steps, step: _Step) -> bool:
    """Whether a force jumped within a step, as it does where a contact closes or friction turns."""
    for j in range(step.twist.shape[0]):
        jump = abs(step.twist[j] - step.known[j] * h * h)
        moved_m = jump * step.answer[j] * h * h / 6.0
        if moved_m > steps.error_m and jump > steps.bend * step.largest[j]:
            return True
    return False


@inline
def _learn_bends(h: float, step: _Step) -> None:
    """Keep how the forces bent within a step without a jump, for the next one."""
    for j in range(step.twist.shape[0]):
        step.known[j] = step.twist[j] / (h * h)


@inline
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


@inline
def _fill(t_s: Array, before: int, after: int, out: Trajectory) -> None:
    """Write the motion at the nodes within a stride, by Hermite's cubics."""
    gap = t_s[after] - t_s[before]
    for i in range(out.heights_m.shape[1]):
        z, w = out.heights_m[:, i], out.velocities_m_per_s[:, i]
        a = out.accelerations_m_per_s2[:, i]
        for node in range(before + 1, after):
            share = (t_s[node] - t_s[before]) / gap
            z[node] = z[before] + _cubic(
                z[after] - z[before], gap * w[before], gap * w[after], share
            )
            w[node] = w[before] + _cubic(
                w[after] - w[before], gap * a[before], gap * a[after], share
            )
            a[node] = a[before] + share * (a[after] - a[before])


class Directions(NamedTuple):
    """The parameters by which a simulation is differentiated: their columns, or -1.

    Attributes:
        columns: Number of columns.
        stiffness: Of each strut, shape (struts,); about mid-stroke.
        damping: Likewise.
        preload: Likewise.
        free_length: Likewise; the linear spring stays as it is.
        mass: Of a kg on each strut's body, shape (struts,).
        gain: Of each input, shape (inputs,).
        parameters: Of each parameter of an effect, shape (P,).
        start: Of the first entry of the initial vector.
    """

    columns: int
    stiffness: Integers
    damping: Integers
    preload: Integers
    free_length: Integers
    mass: Integers
    gain: Integers
    parameters: Integers
    start: int


class ByLinearPart(NamedTuple):
    """How the linear part enters the equations.

    Attributes:
        middles_m: Mid-stroke of each strut, shape (struts,).
        mass: Change of the mass matrix by a kg on each strut's body, shape (K, struts, n, n).
        bias: The same of the bias force, shape (K, struts, n).
        inputs: The same of the inputs, shape (K, struts, n, inputs).
        gains: Generalised force per unit of each input by its gain, shape (K, n, inputs).
    """

    middles_m: Array
    mass: Array
    bias: Array
    inputs: Array
    gains: Array


class Tangents(NamedTuple):
    """Derivatives of strut motions at the nodes, each of shape (N, struts, columns).

    Those of the velocities are empty where they are not needed.
    """

    heights: Array
    velocities: Array


class _Stages(NamedTuple):
    """Where the four stages of a step evaluated the slope, and the slopes; (4, 2 n + states)."""

    x: Array
    slope: Array


class _TangentWork(NamedTuple):
    """Derivatives that an evaluation leaves behind, and the sums of a step.

    Attributes:
        x: Of the state where the slope is evaluated, shape (2 n + states, columns).
        slope: Of the slope, likewise.
        general: Of the generalised force, shape (n, columns).
        heights: Of the heights, shape (struts, columns).
        velocities: Of their rates, likewise.
        forces: Of the struts' forces, likewise.
        laws: Derivatives of a law's force, then of its rates, one row after another.
        at: Of the state at the beginning of the step, or of a part of it, as `x`.
        total: Of the sum of slopes, likewise.
        rates: Of the velocities at the last stride's beginning and its end, shape (2, struts,
            columns).
    """

    x: Array
    slope: Array
    general: Array
    heights: Array
    velocities: Array
    forces: Array
    laws: Array
    at: Array
    total: Array
    rates: Array


class _SlopeCalls(NamedTuple):
    """The derivatives of the laws, with a pointer to where each writes."""

    forces: tuple[SlopesOverArrays, ...]
    rates: tuple[SlopesOverArrays, ...]
    force_rows: Writable
    rate_rows: Writable


@inline
def _add_scaled(factor: float, source: Array, row: int, out: Array, to: int) -> None:
    """Add a multiple of a row to another."""
    for d in range(source.shape[1]):
        out[to, d] += factor * source[row, d]


@inline
def _move_tangents(equations: Equations, at: _Instant, tangent: _TangentWork) -> None:
    """Write the derivatives of heights and velocities."""
    rows, a, b = equations.jacobian, at.before, at.after
    n = rows.shape[2]
    tangent.heights[:] = 0.0
    tangent.velocities[:] = 0.0
    for i in range(rows.shape[1]):
        for j in range(n):
            row = rows[a, i, j] + at.share * (rows[b, i, j] - rows[a, i, j])
            _add_scaled(row, tangent.x, j, tangent.heights, i)
            _add_scaled(row, tangent.x, n + j, tangent.velocities, i)


@inline
def _linear_tangents(
    struts: Array, directions: Directions, by: ByLinearPart, work: _Work, tangent: _TangentWork
) -> None:
    """Write the derivatives of the forces of springs and dampers."""
    tangent.forces[:] = 0.0
    for i in range(struts.shape[0]):
        _add_scaled(-struts[i, STIFFNESS], tangent.heights, i, tangent.forces, i)
        _add_scaled(-struts[i, DAMPING], tangent.velocities, i, tangent.forces, i)
        if directions.stiffness[i] >= 0:
            tangent.forces[i, directions.stiffness[i]] -= work.heights_m[i] - by.middles_m[i]
        if directions.damping[i] >= 0:
            tangent.forces[i, directions.damping[i]] -= work.velocities[i]
        if directions.preload[i] >= 0:
            tangent.forces[i, directions.preload[i]] += 1.0


@inline
def _add_law(
    rows: tuple[int, int, int], places: tuple[int, int, int], directions: Directions,
    tangent: _TangentWork, out: Array, to: int,
) -> None:  # fmt: skip
    """Add the derivatives of a force or a rate.

    `rows` are its first derivative in `laws` and the numbers of its states and parameters;
    `places` the strut, the first state and the first parameter.
    """
    first, states, parameters = rows
    strut, first_state, first_parameter = places
    laws = tangent.laws
    _add_scaled(laws[first], tangent.heights, strut, out, to)
    _add_scaled(laws[first + 1], tangent.velocities, strut, out, to)
    for s in range(states):
        _add_scaled(laws[first + 2 + s], tangent.x, first_state + s, out, to)
    for p in range(parameters):
        column = directions.parameters[first_parameter + p]
        if column >= 0:
            out[to, column] += laws[first + 2 + states + p]
    constants = first + 2 + states + parameters
    if directions.free_length[strut] >= 0:
        out[to, directions.free_length[strut]] += laws[constants]
    if directions.stiffness[strut] >= 0:
        out[to, directions.stiffness[strut]] += laws[constants + 1]
    if directions.damping[strut] >= 0:
        out[to, directions.damping[strut]] += laws[constants + 2]


@inline
def _add_effect_tangents(
    placement: Placement, sizes: Integers, calls: _Calls, slopes: _SlopeCalls,
    directions: Directions, at: _Instant, work: _Work, tangent: _TangentWork,
) -> None:  # fmt: skip
    """Add the derivatives of the effects' forces, and write those of their states' rates."""
    n = tangent.general.shape[0]
    for slot in range(SLOTS):
        if slot >= placement.struts.shape[0]:
            break
        i: int = placement.struts[slot]
        states = sizes[slot, 0]
        parameters = sizes[slot, 1]
        width = 2 + states + parameters + 4
        first_state = 2 * n + max(placement.first_states[slot], 0)
        places = (i, first_state, placement.first_parameters[slot])
        slopes.forces[slot](
            at.t_s, work.heights_m[i], work.velocities[i], at.applied_n, at.temperature_c,
            calls.states[slot], calls.parameters[slot], calls.struts[slot], slopes.force_rows,
        )  # fmt: skip
        _add_law((0, states, parameters), places, directions, tangent, tangent.forces, i)
        if states > 0:
            slopes.rates[slot](
                at.t_s, work.heights_m[i], work.velocities[i], at.applied_n, at.temperature_c,
                calls.states[slot], calls.parameters[slot], calls.struts[slot], slopes.rate_rows,
            )  # fmt: skip
            for s in range(states):
                for d in range(tangent.slope.shape[1]):
                    tangent.slope[first_state + s, d] = 0.0
                rows = (tangent.laws.shape[0] // 2 + s * width, states, parameters)
                _add_law(rows, places, directions, tangent, tangent.slope, first_state + s)


@inline
def _accelerate_tangents(
    equations: Equations, by: ByLinearPart, directions: Directions, at: _Instant, work: _Work,
    tangent: _TangentWork,
) -> None:  # fmt: skip
    """Write the derivatives of the slope of coordinates and rates."""
    rows, a, b, share = equations.jacobian, at.before, at.after, at.share
    inverses = equations.mass_inverse
    n = rows.shape[2]
    columns = tangent.x.shape[1]
    tangent.general[:] = 0.0
    for j in range(n):
        for i in range(rows.shape[1]):
            row = rows[a, i, j] + share * (rows[b, i, j] - rows[a, i, j])
            _add_scaled(row, tangent.forces, i, tangent.general, j)
        for i in range(n):
            if equations.bias_q[a, j, i] != 0.0:
                _add_scaled(equations.bias_q[a, j, i], tangent.x, i, tangent.general, j)
            if equations.bias_v[a, j, i] != 0.0:
                _add_scaled(equations.bias_v[a, j, i], tangent.x, n + i, tangent.general, j)
        for i in range(rows.shape[1]):
            if directions.mass[i] >= 0:
                more = by.bias[a, i, j] + share * (by.bias[b, i, j] - by.bias[a, i, j])
                for k in range(work.inputs.shape[0]):
                    more += by.inputs[a, i, j, k] * work.inputs[k]
                for l in range(n):
                    more -= by.mass[a, i, j, l] * work.slope[n + l]
                tangent.general[j, directions.mass[i]] += more
        for k in range(work.inputs.shape[0]):
            if directions.gain[k] >= 0:
                tangent.general[j, directions.gain[k]] += by.gains[a, j, k] * work.inputs[k]
    for j in range(n):
        for d in range(columns):
            tangent.slope[j, d] = tangent.x[n + j, d]
            tangent.slope[n + j, d] = 0.0
        for i in range(n):
            inverse = inverses[a, j, i]
            inverse += share * (inverses[b, j, i] - inverse)
            _add_scaled(inverse, tangent.general, i, tangent.slope, n + j)


@inline
def _step_tangents(
    model: Model, sizes: Integers, calls: _Calls, slopes: _SlopeCalls, scenario: Scenario,
    directions: Directions, by: ByLinearPart, span: _Span, part: tuple[float, float],
    stages: _Stages, work: _Work, tangent: _TangentWork,
) -> None:  # fmt: skip
    """Move the derivatives of the state over a part of a step: where it begins, and its length."""
    tabulated = model.equations.jacobian.shape[0] > 1
    first, length = part
    h = span.step_s * length
    size, columns = tangent.x.shape
    for stage in range(4):
        at = _instant(span, first + 0.5 * ((stage + 1) // 2) * length)
        for i in range(size):
            work.x[i] = stages.x[stage, i]
            work.slope[i] = stages.slope[stage, i]
        reach = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
        for i in range(size):
            for d in range(columns):
                tangent.x[i, d] = tangent.at[i, d] + reach * tangent.slope[i, d]
        if tabulated:
            _follow_reference(model.equations, at, work)
        _write_inputs(scenario.inputs, at, work)
        _move_struts(model.equations, at, work, tabulated)
        if scenario.moved.shape[0] > 0:
            _add_moved(scenario.moved, at, work)
        _move_tangents(model.equations, at, tangent)
        _linear_tangents(model.struts, directions, by, work, tangent)
        _add_effect_tangents(model.placement, sizes, calls, slopes, directions, at, work, tangent)
        _accelerate_tangents(model.equations, by, directions, at, work, tangent)
        weight = 2.0 if 0 < stage < 3 else 1.0
        for i in range(size):
            for d in range(columns):
                if stage == 0:
                    tangent.total[i, d] = tangent.slope[i, d]
                else:
                    tangent.total[i, d] += weight * tangent.slope[i, d]
    for i in range(size):
        for d in range(columns):
            tangent.at[i, d] += h / 6.0 * tangent.total[i, d]


@inline
def _record_tangents(
    equations: Equations, t_s: Array, before: int, node: int, tangent: _TangentWork, out: Tangents
) -> None:
    """Write the derivatives at a node, and at those since the one before, by Hermite's cubics."""
    rows = equations.jacobian
    a = node if rows.shape[0] > 1 else 0
    n = rows.shape[2]
    for i in range(rows.shape[1]):
        for d in range(tangent.at.shape[1]):
            height = 0.0
            velocity = 0.0
            for j in range(n):
                height += rows[a, i, j] * tangent.at[j, d]
                velocity += rows[a, i, j] * tangent.at[n + j, d]
            out.heights[node, i, d] = height
            tangent.rates[0, i, d] = tangent.rates[1, i, d]
            tangent.rates[1, i, d] = velocity
            if out.velocities.shape[0] > 0:
                out.velocities[node, i, d] = velocity
    gap = t_s[node] - t_s[before]
    for within in range(before + 1, node):
        share = (t_s[within] - t_s[before]) / gap
        for i in range(rows.shape[1]):
            for d in range(tangent.at.shape[1]):
                begin = out.heights[before, i, d]
                rise = out.heights[node, i, d] - begin
                early = gap * tangent.rates[0, i, d]
                late = gap * tangent.rates[1, i, d]
                out.heights[within, i, d] = begin + _cubic(rise, early, late, share)
                if out.velocities.shape[0] > 0:
                    out.velocities[within, i, d] = _cubic_rate(rise, early, late, share) / gap


@inline
def _march(
    model: Model, sizes: Integers, calls: _Calls, slopes: _SlopeCalls, scenario: Scenario,
    steps: Steps, directions: Directions, by: ByLinearPart, work: _Work, step: _Step,
    stages: _Stages, tangent: _TangentWork, out: Trajectory, parts: Integers, tangents: Tangents,
) -> bool:  # fmt: skip
    # Laws take bare pointers, because an array would be counted as held and released at each call.
    # The pointers come as arguments: numba has no arithmetic to make them of others in the loop,
    # and to cut an array there for each call takes longer than most laws.
    tabulated = model.equations.jacobian.shape[0] > 1
    farthest_m = 1e3 * steps.stroke_m + 1e3 * abs(model.equations.heights_m[0, 0])
    last = scenario.strides.shape[0] - 1
    size, columns = tangent.x.shape
    before = 0
    for stride in range(last + 1):
        node: int = scenario.strides[stride]
        if columns > 0:
            _record_tangents(model.equations, scenario.t_s, before, node, tangent, tangents)
        parts[stride] = 1
        for substep in range(steps.substeps):
            span = _span(scenario, steps.substeps, stride, substep, tabulated)
            begin = 0
            length = _PARTS
            while begin < _PARTS:
                h = span.step_s * length / _PARTS
                for i in range(size):
                    step.began[i] = step.x[i]
                for stage in range(4):
                    # Nodes of the classical Runge-Kutta method: 0, 1/2, 1/2, 1.
                    u = (begin + 0.5 * ((stage + 1) // 2) * length) / _PARTS
                    _begin_stage(stage, h, step, work)
                    _write_slope(model, calls, scenario, _instant(span, u), work)
                    if stage == 0 and substep == 0 and begin == 0 and length == _PARTS:
                        _record(model.equations, node, work, out)
                        _fill(scenario.t_s, before, node, out)
                        if stride == last:
                            return True
                    if columns > 0:
                        for i in range(size):
                            stages.x[stage, i] = work.x[i]
                            stages.slope[stage, i] = work.slope[i]
                    _end_stage(stage, h, step, work)
                jumped = _has_jump(h, steps, step)
                if jumped and length > 1:
                    # Again, in parts.
                    for i in range(size):
                        step.x[i] = step.began[i]
                    length //= _CUTS
                    continue
                if not jumped:
                    _learn_bends(h, step)
                parts[stride] = max(parts[stride], _PARTS // length)
                if columns > 0:
                    _step_tangents(
                        model, sizes, calls, slopes, scenario, directions, by, span,
                        (begin / _PARTS, length / _PARTS), stages, work, tangent,
                    )  # fmt: skip
                begin += length
                while length < _PARTS and begin % (_CUTS * length) == 0:
                    length *= _CUTS
        before = node
        if not abs(work.heights_m[0]) < farthest_m:
            return False
    return True


# Signatures of what is kept on disk hold plain tuples: numba's index of it names the classes of
# a signature, and could not be read after one of them was renamed.
_PLACEMENT = types.UniTuple(INTEGERS, 3)
_EQUATIONS = types.Tuple((CUBE, MATRIX, CUBE, CUBE, CUBE, MATRIX, MATRIX, CUBE, MATRIX, MATRIX))
_MODEL = types.Tuple((_PLACEMENT, VECTOR, MATRIX, _EQUATIONS))
_SCENARIO = types.Tuple((VECTOR, VECTOR, INTEGERS, VECTOR, VECTOR, MATRIX, CUBE))
_STEPS = types.Tuple((I8, F8, F8, F8))
_TRAJECTORY = types.UniTuple(MATRIX, 3)
_FOUR = types.Array(types.float64, 4, "C")
_DIRECTIONS = types.Tuple((I8, *(INTEGERS,) * 7, I8))
_BY_LINEAR_PART = types.Tuple((VECTOR, _FOUR, CUBE, _FOUR, CUBE))
_LAW_SIZES = types.Array(types.int64, 2, "C")
_TANGENTS = types.UniTuple(CUBE, 2)


def _simulate(
    laws: tuple[Forces, Rates, Rates, Rates],
    sizes: Integers,
    model_parts: tuple[tuple[Integers, ...], Array, Array, Arrays],
    scenario_parts: tuple[Array, Array, Integers, Array, Array, Array, Array],
    steps: tuple[int, float, float, float],
    direction_parts: tuple[
        int, Integers, Integers, Integers, Integers, Integers, Integers, Integers, int
    ],
    linear_parts: Arrays,
    out: Arrays,
    parts: Integers,
    tangents: Arrays,
) -> bool:
    # Pointers hold nothing: what they lead to is held by this function or by its caller.
    placement, equations = Placement(*model_parts[0]), Equations(*model_parts[3])
    model = Model(placement, model_parts[1], model_parts[2], equations)
    scenario = Scenario(*scenario_parts)
    directions, by = Directions(*direction_parts), ByLinearPart(*linear_parts)
    start, struts = scenario.start, model.struts
    size = start.shape[0]
    columns = directions.columns
    count, n = equations.jacobian.shape[1:]
    states = np.zeros(SLOTS, dtype=np.int64)
    parameters = np.zeros(SLOTS, dtype=np.int64)
    strut = np.zeros(SLOTS, dtype=np.int64)
    longest = 1
    effects = placement.struts.shape[0]
    for slot in range(effects):
        states[slot] = 2 * n + max(placement.first_states[slot], 0)
        parameters[slot] = placement.first_parameters[slot]
        strut[slot] = placement.struts[slot] * struts.shape[1]
        width = 6 + sizes[slot, 0] + sizes[slot, 1]
        longest = max(longest, width * max(1, sizes[slot, 0]))
    work = _Work(
        np.zeros(equations.inputs.shape[2]), start.copy(), np.zeros(size),
        equations.q[0].copy(), equations.v[0].copy(),
        np.zeros(n), np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(effects),
    )  # fmt: skip
    calls = _Calls(
        ten(laws[0]), ten(laws[1]),
        pointers(work.x, states), pointers(work.slope, states),
        pointers(model.parameters, parameters), pointers(struts.ravel(), strut),
    )  # fmt: skip
    step = _Step(
        start.copy(), start.copy(), np.zeros(size), np.zeros(effects), np.zeros(effects),
        np.zeros(effects), np.zeros(effects),
    )  # fmt: skip
    for slot in range(effects):
        row = equations.jacobian[0, placement.struts[slot]]
        for j in range(n):
            for i in range(n):
                step.answer[slot] += row[j] * equations.mass_inverse[0, j, i] * row[i]
    stages = _Stages(np.zeros((4, size)), np.zeros((4, size)))
    tangent = _TangentWork(
        np.zeros((size, columns)), np.zeros((size, columns)), np.zeros((n, columns)),
        np.zeros((count, columns)), np.zeros((count, columns)), np.zeros((count, columns)),
        np.zeros(2 * longest),
        np.zeros((size, columns)), np.zeros((size, columns)), np.zeros((2, count, columns)),
    )  # fmt: skip
    if directions.start >= 0:
        for i in range(size):
            tangent.at[i, directions.start + i] = 1.0
    slopes = _SlopeCalls(
        ten(laws[2]), ten(laws[3]), pointer(tangent.laws, 0), pointer(tangent.laws, longest)
    )
    return _march(
        model, sizes, calls, slopes, scenario, Steps(*steps), directions, by, work, step, stages,
        tangent, Trajectory(*out), parts, Tangents(*tangents),
    )  # fmt: skip


_simulate = compile_loop(
    _simulate,
    types.boolean(
        types.Tuple((FORCES, RATES, RATES, RATES)),
        _LAW_SIZES,
        _MODEL,
        _SCENARIO,
        _STEPS,
        _DIRECTIONS,
        _BY_LINEAR_PART,
        _TRAJECTORY,
        INTEGERS,
        _TANGENTS,
    ),
)


def simulate(
    slots: Slots,
    model: Model,
    scenario: Scenario,
    steps: Steps,
    out: Trajectory,
    parts: Integers | None = None,
) -> bool:
    """Free-run simulation, written to `out`, by the classical Runge-Kutta method.

    `parts` are filled with the numbers of parts into which a step of each stride was cut at most,
    shape (S + 1,).

    Returns:
        Whether the motion stayed finite.
    """
    struts, inputs = model.equations.jacobian.shape[1], model.equations.inputs.shape[2]
    none = np.full(max(struts, inputs, len(model.parameters)), -1)
    _, n, _ = model.equations.mass_inverse.shape
    directions = Directions(0, none, none, none, none, none, none, none, -1)
    by = ByLinearPart(
        np.zeros(0), np.zeros((0, 0, n, n)), np.zeros((0, 0, n)), np.zeros((0, 0, n, 0)),
        np.zeros((0, n, 0)),
    )  # fmt: skip
    tangents = Tangents(np.empty((0, struts, 0)), np.empty((0, struts, 0)))
    return _start(slots, NO_SLOPES, model, scenario, steps, directions, by, out, tangents, parts)


def differentiate(
    slots: Slots,
    model: Model,
    scenario: Scenario,
    steps: Steps,
    directions: Directions,
    by: ByLinearPart,
    out: Trajectory,
    tangents: Tangents,
) -> bool:
    """Free-run simulation with its derivatives by parameters, written to `out` and `tangents`.

    Returns:
        Whether the motion stayed finite.
    """
    return _start(slots, slots.slopes, model, scenario, steps, directions, by, out, tangents)


def _start(
    slots: Slots, slopes: LawSlopes, model: Model, scenario: Scenario, steps: Steps,
    directions: Directions, by: ByLinearPart, out: Trajectory, tangents: Tangents,
    parts: Integers | None = None,
) -> bool:  # fmt: skip
    whole = (tuple(model.placement), model.parameters, model.struts, tuple(model.equations))
    laws = slots.laws.forces, slots.laws.rates, slopes.forces, slopes.rates
    if parts is None:
        parts = np.empty(len(scenario.strides), dtype=np.int64)
    return _simulate(
        laws, slots.sizes, whole, scenario[:], steps[:], directions[:], by[:], tuple(out), parts,
        tuple(tangents),
    )  # fmt: skip
