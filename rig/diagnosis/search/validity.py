"""Defects for which a fitted model is not used: unidentifiable, linear, cancelling, active laws.

Reference: van der Schaft, L2-Gain and Passivity Techniques in Nonlinear Control (2017), 2, for
passivity; here power is evaluated where the motion was.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.periodic_force import PERIODIC_FORCE
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.linear_part import PARAMETERS
from rig.diagnosis.problem.problem import (
    Problem,
    StrutEffect,
    slots_of,
    strut_constants,
    strut_effects,
)
from rig.diagnosis.problem.track import forces_along, law_force, linear_forces
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import (
    UNBOUND,
    Fit,
    effect_variables,
    fit_covariance,
    law_values,
    start_variables,
)

Array = NDArray[np.float64]

_ONE_LINE = 0.9
"""Share of a drive's power in one line from which on it is a sine."""
_WIDTH = 2
"""Bins on either side that belong to a line under Hann's window."""
_CELLS = 12
"""Cells of height and of velocity in which power is evaluated."""
_VELOCITIES = 8
"""Velocities beyond the recorded ones at which power is evaluated."""
_TINY = 1e-100
"""Least divisor."""
OVER_HEIGHT = ("nonlinear_stiffness", "stop", "backlash")
"""Families whose laws shape the curve of a strut's force over its height."""
_REPLACED = {
    "mass": (),
    "stiffness": OVER_HEIGHT,
    "damping": ("nonlinear_damping", "friction", "fade"),
}
"""Linear parameters whose priors rule laws out, and the families that may replace each."""
_FARTHER = 2.0
"""Deviations by which laws may take a linear parameter farther from the model file's than the best
linear model does, whose own parameters are bent by what it lacks: with a gain that is wrong by a
third beside other effects, a mass went from 3.7 deviations to 5, where it was right."""
SCALED_BY_GAIN = ("mass", "stiffness", "damping")
"""Linear parameters that a gain of the applied force changes in one proportion."""
_PROPORTIONAL = 0.1
"""Deviations of the model file's up to which stiffness and damping changed as the mass did."""
_CHANNELS = ("delay", "input_gain", "periodic_force", "unmodelled_mode")
"""Families that are no property of the strut, or that store energy outside it: may be active."""


def smooth_tracks(problem: Problem, result: Fit) -> list[tuple[int, Track]]:
    """The motion of each recording, by its index, smoothed."""
    forces = (problem.residual_forces(k, result.model) for k in range(problem.recordings))
    return [(k, residual.track) for k, residual in enumerate(forces) if residual is not None]


def find_defect(
    problem: Problem,
    result: Fit,
    lawless: Fit,
    motions: Sequence[tuple[int, Track]],
    criteria: SelectionCriteria,
) -> str | None:
    """The reason for which a model is not used; None where there is none.

    `lawless` is the best linear model.
    """
    forces = forces_along(problem, result.model, motions)
    along = [track for _, track in motions]
    return (
        _find_unbounded_law(problem, result, criteria)
        or _find_linear_law(problem, (result, lawless), forces, along, criteria)
        or _find_cancelling_laws(result, forces, criteria)
        or _find_active_strut(problem, result, along, criteria)
        or find_improbable_linear_part(
            problem, result.candidate.new, result.parts.linear, lawless.parts.linear, criteria
        )
        or _find_harmonic_of_drive(result, along, law_values(problem, result))
    )


def new_laws(result: Fit) -> list[tuple[int, str]]:
    """Index among all effects, and name, of those that the nominal model lacks."""
    first = len(result.candidate.kept)
    return [(first + i, name) for i, (_, name) in enumerate(result.candidate.new)]


def _find_unbounded_law(problem: Problem, result: Fit, criteria: SelectionCriteria) -> str | None:
    """Reason against a law whose size does not differ from zero."""
    for (_, name), size in size_in_deviations(problem, result).items():
        if size < criteria.bounded:
            return f"its size is not identifiable from these data ({name})"
    return None


def size_in_deviations(problem: Problem, result: Fit) -> dict[StrutEffect, float]:
    """Size of each law, in standard deviations from zero, the linear part projected out.

    Laws without a size of their own are left out.
    """
    variables = effect_variables(problem, result)
    jacobian, residual = result.solution.jacobian, result.solution.residual
    starts = start_variables(problem, result)
    linear = np.arange(jacobian.shape[1]) < int(result.free.sum())
    nuisance = jacobian[:, linear | starts]
    nuisance = nuisance[:, np.linalg.norm(nuisance, axis=0) > 0.0]
    basis = np.linalg.qr(nuisance / np.linalg.norm(nuisance, axis=0))[0]
    found: dict[StrutEffect, float] = {}
    for law, (row, name) in zip(result.candidate.new, new_laws(result), strict=True):
        scaled = variables[row][list(effect(name).scaled)]
        if not len(scaled):
            continue
        space = result.space
        sizes = np.where(
            space.logarithmic[scaled], 1.0, result.solution.values[scaled] / space.scale[scaled]
        )
        # Response of the residual to the whole law, all its sizes in one proportion.
        response = jacobian[:, scaled] @ sizes
        response = response - basis @ (basis.T @ response)
        power = float(response @ response)
        scores = np.bincount(result.blocks, response * residual)
        white = np.sqrt(power / max(result.mean_square, 1.0))
        robust = power / max(float(np.linalg.norm(scores)), _TINY)
        found[law] = min(float(white), robust)
    return found


def find_unidentifiable_law(problem: Problem, result: Fit) -> str | None:
    """Reason against a law of a converged fit, all of whose sizes have intervals with zero."""
    half, variables = fit_covariance(result).half, effect_variables(problem, result)
    space = result.space
    sizes = np.where(
        space.logarithmic, np.log(UNBOUND), np.abs(result.solution.values) / space.scale
    )
    for row, name in new_laws(result):
        scaled = variables[row][list(effect(name).scaled)]
        # One without a size of its own takes that of the strut.
        if len(scaled) and not np.any(half[scaled] < sizes[scaled]):
            return f"its size is not identifiable from these data ({name})"
    return None


def _find_linear_law(
    problem: Problem,
    fits: tuple[Fit, Fit],
    forces: list[tuple[int, Array]],
    along: Sequence[Track],
    criteria: SelectionCriteria,
) -> str | None:
    """Reason against a law that is a linear spring and damper along this motion.

    Unless it is at the noise floor, and the linear model, the second of the fits, is not.
    """
    result, lawless = fits
    floor = problem.floor_level(result.model)
    is_at_floor = result.mean_square <= (1.0 + criteria.least_above_noise_later) * floor
    if is_at_floor and lawless.mean_square > criteria.explained**2 * floor:
        return None
    for row, name in new_laws(result):
        strut, force_n = forces[row]
        if is_linear_along(along, strut, force_n, criteria):
            return f"along this motion it is a linear spring and damper ({name})"
    return None


def is_linear_along(
    along: Sequence[Track], strut: int, force_n: Array, criteria: SelectionCriteria
) -> bool:
    """Whether a force (N,) is that of a preload, a spring and a damper along motions."""
    basis = linear_forces(along, strut)
    nonlinear_n = force_n - basis @ (basis.T @ force_n)
    size = float(np.linalg.norm(force_n))
    return size <= 0.0 or float(np.linalg.norm(nonlinear_n)) < criteria.leftover * size


def _find_cancelling_laws(
    result: Fit, forces: list[tuple[int, Array]], criteria: SelectionCriteria
) -> str | None:
    """Reason against two laws of one strut whose forces cancel each other."""
    new = new_laws(result)
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


def find_improbable_linear_part(
    problem: Problem,
    laws: Sequence[StrutEffect],
    linear: Array,
    lawless: Array,
    criteria: SelectionCriteria,
) -> str | None:
    """Reason against laws that require a linear part far from the model file's.

    Only where no correction without a law goes about as far. Laws of a spring may replace the
    linear one, and laws of a damper the linear damping. `linear` are the corrections together with
    the laws, `lawless` those of the best linear model, shapes (L,).
    """
    if _is_gain(problem, linear):
        return None
    families = {(strut, effect(name).family) for strut, name in laws}
    for p, change, alone in zip(problem.linear, linear, lawless, strict=True):
        if p.kind not in _REPLACED:
            continue
        is_replaced = change < 0.0 and any(
            (p.strut, family) in families for family in _REPLACED[p.kind]
        )
        times = abs(float(change)) / p.deviation
        farther = float(np.sign(change) * (change - alone)) / p.deviation
        if times > criteria.improbable and farther > _FARTHER and not is_replaced:
            return (
                f"it requires {PARAMETERS[p.kind]} {p.nominal + float(change):.3g}, "
                f"{times:.2g} standard deviations from the model file's {p.nominal:.3g} "
                "(its tolerance states how well that is known)"
            )
    return None


def _is_gain(problem: Problem, linear: Array) -> bool:
    """Whether mass, stiffness and damping changed in one proportion: the applied force has a gain.

    Of one strut; changes that are alike by chance are one in a hundred.
    """
    kinds = {p.kind: i for i, p in enumerate(problem.linear)}
    if len(problem.motions) > 1 or "gain" not in kinds:
        return False
    of_strut = [
        (problem.linear[kinds[kind]], float(linear[kinds[kind]])) for kind in SCALED_BY_GAIN
    ]
    if any(p.nominal <= 0.0 for p, _ in of_strut):
        return False
    (mass, more_kg), *others = of_strut
    share = more_kg / mass.nominal
    return all(
        abs(change - share * p.nominal) < _PROPORTIONAL * p.deviation for p, change in others
    )


def _find_harmonic_of_drive(
    result: Fit, along: Sequence[Track], values: Mapping[StrutEffect, Array]
) -> str | None:
    """Reason against a periodic force whose frequency is a multiple of that of the drive.

    Whatever is not linear answers a sine by its multiples.
    """
    for law in result.candidate.new:
        if law[1] != PERIODIC_FORCE.name:
            continue
        frequency_hz = PERIODIC_FORCE.named(values[law].tolist())["frequency_hz"]
        orders = [harmonic_of_drive(frequency_hz, law[0], track) for track in along]
        if all(order is not None for order in orders):
            return f"its frequency is {orders[0]} times that of the drive ({law[1]})"
    return None


def harmonic_of_drive(frequency_hz: float, strut: int, track: Track) -> int | None:
    """How many times the drive's frequency a frequency is; None where it is no multiple of a line.

    The drive is the applied force, or the height of a strut where there is none.
    """
    drive = track.applied_n if np.any(track.applied_n) else track.heights_m[strut]
    length_s = float(track.t_s[-1] - track.t_s[0])
    power = np.abs(np.fft.rfft((drive - drive.mean()) * np.hanning(len(drive)))) ** 2
    line = int(np.argmax(power))
    around = slice(max(line - _WIDTH, 0), line + _WIDTH + 1)
    if line == 0 or float(power[around].sum()) < _ONE_LINE * float(power.sum()):
        return None
    bins = np.arange(len(power))[around]
    line_hz = float(np.average(bins, weights=power[around])) / length_s
    order = round(frequency_hz / line_hz)
    off_hz = abs(frequency_hz - order * line_hz)
    return order if order > 0 and off_hz < max(order, _WIDTH) * 0.5 / length_s else None


def _find_active_strut(
    problem: Problem, result: Fit, along: Sequence[Track], criteria: SelectionCriteria
) -> str | None:
    """Reason against a strut that feeds energy in, along the motion or at higher velocities."""
    for strut in range(len(problem.motions)):
        if not any(at == strut for at, _ in result.candidate.new):
            continue
        z = np.concatenate([track.heights_m[strut] for track in along])
        w = np.concatenate([track.velocities_m_per_s[strut] for track in along])
        cells = np.unique(np.column_stack([_cell(z), _cell(w)]), axis=0, return_index=True)[1]
        power = _damper_power(problem, result, strut, z[cells], w[cells])
        tolerance = criteria.passive * max(-float(power.min()), 0.0)
        name = problem.spec.struts[strut].name
        if float(power.max()) > tolerance:
            return f"strut {name} would feed energy in (not passive)"
        heights = z[np.unique(_cell(z), return_index=True)[1]]
        faster = float(np.abs(w).max()) * np.geomspace(1.0, criteria.dissipating_to, _VELOCITIES)
        faster = np.concatenate([-faster, faster])
        power = _damper_power(problem, result, strut, *map(np.ravel, np.meshgrid(heights, faster)))
        if float(power.max()) > tolerance:
            return f"strut {name} would feed energy in at higher velocities (not passive)"
    return None


def _damper_power(problem: Problem, result: Fit, strut: int, z: Array, w: Array) -> Array:
    """Power in W that the part of a strut's force that vanishes at rest feeds in, shape (N,).

    At heights `z` in m and velocities `w` in m/s, shapes (N,).
    """
    constants = strut_constants(problem, result.parts.linear)
    moving = _points(z, w, len(problem.motions), strut)
    still = moving._replace(velocities_m_per_s=np.zeros_like(moving.velocities_m_per_s))
    force = -constants[strut, 2] * w
    slots = slots_of(problem, result.candidate).each
    for (at, name), slot in zip(strut_effects(problem, result.candidate), slots, strict=True):
        if at == strut and effect(name).family not in _CHANNELS and not effect(name).state_size:
            values = result.parts.effects[slot.parameters]
            force = force + law_force(moving, strut, name, values, constants)
            force = force - law_force(still, strut, name, values, constants)
    return force * w


def _cell(values: Array) -> Array:
    """Cell of each value, by equal parts of their range."""
    low, high = float(values.min()), float(values.max())
    return np.minimum(((values - low) / max(high - low, _TINY) * _CELLS).astype(int), _CELLS - 1)


def _points(z: Array, w: Array, struts: int, strut: int) -> Track:
    """Points of height and velocity as a track, for laws without internal state; shapes (N,)."""
    heights, velocities = np.zeros((struts, len(z))), np.zeros((struts, len(z)))
    heights[strut], velocities[strut] = z, w
    zero = np.zeros(len(z))
    return Track(np.arange(len(z), dtype=np.float64), heights, velocities, zero, zero + 20.0)
