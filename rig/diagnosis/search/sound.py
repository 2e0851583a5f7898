"""Which fitted models an engineer would use: passive, bounded, and nothing that cancels itself.

Reference: van der Schaft, L2-Gain and Passivity Techniques in Nonlinear Control (2017), 2, for
passivity; here power is looked at where the motion was.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.problem.problem import Problem, Track, placed, slots_of, strut_constants
from rig.diagnosis.problem.track import forces_along, law_force, linear_forces
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import UNBOUND, Fit, effect_variables, spread, start_variables

Array = NDArray[np.float64]

_CELLS = 12
"""Cells of height and of velocity in which power is looked at."""
_TINY = 1e-100
"""Stands for nothing in a quotient."""
_CHANNELS = ("delay", "input_gain", "periodic_force", "unmodelled_mode")
"""Families that are no property of the strut, or that store energy outside it."""


def tracks(problem: Problem, result: Fit) -> list[tuple[int, Track]]:
    """The motion of each recording, by its index, smoothed."""
    forces = (
        problem.residual_forces(k, result.candidate, result.parts)
        for k in range(problem.recordings)
    )
    return [(k, there.track) for k, there in enumerate(forces) if there is not None]


def unsound(
    problem: Problem, result: Fit, motions: Sequence[tuple[int, Track]], criteria: SelectionCriteria
) -> str | None:
    """Why a model is not to be used; None if it is.

    Args:
        problem: Model and recordings.
        result: The fitted model.
        motions: The motion of recordings, by their index.
        criteria: What decides.
    """
    forces = forces_along(problem, result.candidate, result.parts, motions)
    along = [track for _, track in motions]
    return (
        _unbound(problem, result, criteria)
        or _disguised(result, forces, along, criteria)
        or _cancelling(result, forces, criteria)
        or _active(problem, result, along, criteria)
    )


def _new(result: Fit) -> list[tuple[int, str]]:
    """Place among all effects, and name, of those that the nominal model lacks."""
    first = len(result.candidate.kept)
    return [(first + i, name) for i, (_, name) in enumerate(result.candidate.new)]


def _unbound(problem: Problem, result: Fit, criteria: SelectionCriteria) -> str | None:
    """A law whose size, beyond what the linear part could give, is not away from nothing."""
    variables = effect_variables(problem, result)
    jacobian, residual = result.solution.jacobian, result.solution.residual
    starts = start_variables(problem, result)
    linear = np.arange(jacobian.shape[1]) < int(result.free.sum())
    nuisance = jacobian[:, linear | starts]
    nuisance = nuisance[:, np.linalg.norm(nuisance, axis=0) > 0.0]
    basis = np.linalg.qr(nuisance / np.linalg.norm(nuisance, axis=0))[0]
    for row, name in _new(result):
        scaled = variables[row][list(effect(name).scaled)]
        if not len(scaled):
            continue
        space = result.space
        sizes = np.where(
            space.logarithmic[scaled], 1.0, result.solution.values[scaled] / space.scale[scaled]
        )
        # What the whole law adds to the residual, all its sizes in one proportion.
        answer = jacobian[:, scaled] @ sizes
        answer = answer - basis @ (basis.T @ answer)
        power = float(answer @ answer)
        scores = np.bincount(result.blocks, answer * residual)
        white = np.sqrt(power / max(result.mean_square, 1.0))
        robust = power / max(float(np.linalg.norm(scores)), _TINY)
        if min(float(white), robust) < criteria.bounded:
            return f"the data do not bound its size ({name})"
    return None


def unmeasured(problem: Problem, result: Fit) -> str | None:
    """A law none of whose sizes has an interval that leaves out nothing; None if there is none.

    Args:
        problem: Model and recordings.
        result: The model, fitted to its end.
    """
    half, variables = spread(result).half, effect_variables(problem, result)
    space = result.space
    sizes = np.where(
        space.logarithmic, np.log(UNBOUND), np.abs(result.solution.values) / space.scale
    )
    for row, name in _new(result):
        scaled = variables[row][list(effect(name).scaled or (0,))]
        if not np.any(half[scaled] < sizes[scaled]):
            return f"the data do not bound its size ({name})"
    return None


def _disguised(
    result: Fit,
    forces: list[tuple[int, Array]],
    along: Sequence[Track],
    criteria: SelectionCriteria,
) -> str | None:
    """A law that is a linear spring and damper along this motion."""
    for row, name in _new(result):
        strut, force = forces[row]
        basis = linear_forces(along, strut)
        left = force - basis @ (basis.T @ force)
        power = float(np.linalg.norm(force))
        if power <= 0.0 or float(np.linalg.norm(left)) < criteria.leftover * power:
            return f"along this motion it is a linear spring and damper ({name})"
    return None


def _cancelling(
    result: Fit, forces: list[tuple[int, Array]], criteria: SelectionCriteria
) -> str | None:
    """Two laws of one strut, each of which takes back what the other gives."""
    new = _new(result)
    for i, (row, name) in enumerate(new):
        for other_row, other in new[i + 1 :]:
            (strut, force), (other_strut, other_force) = forces[row], forces[other_row]
            if strut != other_strut:
                continue
            a, b = force - force.mean(), other_force - other_force.mean()
            size = float(np.linalg.norm(a) * np.linalg.norm(b))
            if size > 0.0 and float(a @ b) < criteria.cancelling * size:
                return f"{name} and {other} cancel each other"
    return None


def _active(
    problem: Problem, result: Fit, along: Sequence[Track], criteria: SelectionCriteria
) -> str | None:
    """A strut that feeds energy in at a height and velocity that the motion went through."""
    constants = strut_constants(problem, result.parts.linear)
    slots = slots_of(problem, result.candidate).each
    effects = placed(problem, result.candidate)
    for strut in range(len(problem.motions)):
        if not any(at == strut for at, _ in result.candidate.new):
            continue
        z = np.concatenate([track.heights_m[strut] for track in along])
        w = np.concatenate([track.velocities_m_per_s[strut] for track in along])
        cells = np.unique(np.column_stack([_cell(z), _cell(w)]), axis=0, return_index=True)[1]
        here = _at_rest(z[cells], w[cells], len(problem.motions), strut)
        still = here._replace(velocities_m_per_s=np.zeros_like(here.velocities_m_per_s))
        force = -constants[strut, 2] * w[cells]
        for (at, name), slot in zip(effects, slots, strict=True):
            if at == strut and effect(name).family not in _CHANNELS and not effect(name).state_size:
                values = result.parts.effects[slot.parameters]
                force = force + law_force(here, strut, name, values, constants)
                force = force - law_force(still, strut, name, values, constants)
        power = force * w[cells]
        if float(power.max()) > criteria.passive * max(-float(power.min()), 0.0):
            name = problem.spec.struts[strut].name
            return f"strut {name} would feed energy in (not passive)"
    return None


def _cell(values: Array) -> Array:
    low, high = float(values.min()), float(values.max())
    return np.minimum(((values - low) / max(high - low, _TINY) * _CELLS).astype(int), _CELLS - 1)


def _at_rest(z: Array, w: Array, struts: int, strut: int) -> Track:
    """Points of height and velocity as a track, for laws without internal state."""
    heights, velocities = np.zeros((struts, len(z))), np.zeros((struts, len(z)))
    heights[strut], velocities[strut] = z, w
    zero = np.zeros(len(z))
    return Track(np.arange(len(z), dtype=np.float64), heights, velocities, zero, zero + 20.0)
