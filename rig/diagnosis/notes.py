"""Notes on a diagnosis: what limits it, what else would look the same, and what to do."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.spec import ModelSpec
from rig.diagnosis.estimates import (
    FitEstimates,
    LawFound,
    find_preload_of_springs,
    free_parameters,
)
from rig.diagnosis.free_length import notes_of_springs
from rig.diagnosis.outcome import IMPROBABLE, ChannelCorrection, HeldOut
from rig.diagnosis.problem.linear_part import PARAMETERS
from rig.diagnosis.problem.problem import Problem, ResidualForces, rms
from rig.diagnosis.problem.track import forces_along
from rig.diagnosis.search.fit import Fit, effect_variables
from rig.diagnosis.search.model_selection import SearchResult
from rig.recordings.stretches import find_stretches

Array = NDArray[np.float64]

_LIKE = 0.01
"""Difference of two shares up to which they count as one, however narrow their intervals."""
_HOLD = 0.3
"""Share of half a sampling interval within which a delay may be that of a zero-order hold."""
_FAR = 3.0
"""Standard deviations from a stated value that one in 370 corrections exceeds by chance."""
_STANDSTILL = 0.02
"""Share of the speed that is exceeded in a twentieth of the time, below which a strut rests."""
_SHORTEST_REST_S = 0.3
"""Time in standstill from which on a strut rests: it passes a turning point in less."""
_LEAST_REST = 0.05
"""Share of the time from which on rests, or motion, are worth a note."""
_MOSTLY = 2.0
"""Ratio of the remaining forces at standstill and in motion from which on the former decides."""
_RISEN = 1.1
"""Ratio of two residual forces from which on one has risen: their floors scatter by a tenth."""
_FRICTION_LIKE = 0.2
"""Share of a damper law's RMS that differs from dry friction, below which it acts as that."""


def notes_on(
    problem: Problem,
    search: SearchResult,
    estimates: FitEstimates,
    laws: Sequence[LawFound],
    channels: Sequence[ChannelCorrection],
    corrected: ModelSpec,
    after: Sequence[ResidualForces | None],
    held_out: HeldOut,
) -> tuple[str, ...]:
    """All notes on a diagnosis.

    Args:
        problem: Model and recordings.
        search: What the search found.
        estimates: The fit of the chosen model.
        laws: Its laws.
        channels: Corrections of channels.
        corrected: The chosen model.
        after: Force that it leaves in each recording.
        held_out: Errors on held-out data.
    """
    chosen = estimates.fit
    return (
        *_notes_of_search(problem, search, laws, by_blocks=held_out.source == "blocks"),
        *_notes_of_zero_and_gain(problem, estimates),
        *notes_of_springs(problem, chosen, estimates.covariance, corrected.struts),
        *_notes_of_channels(channels),
        *_notes_of_bounds(problem, estimates),
        *_notes_of_edges(problem, laws),
        *_notes_of_friction_like_laws(problem, chosen, after),
        *_notes_of_standstill(problem, after),
        *notes_of_opposite_errors(held_out),
    )


def notes_of_opposite_errors(held_out: HeldOut) -> tuple[str, ...]:
    """Whether the force that is missing grows while the height error falls, and what that means."""
    heights, force = held_out.height_rmse_m, held_out.residual_force_rmse_n
    if not (heights.after < heights.before and force.after > _RISEN * force.before):
        return ()
    return (
        f"The height error falls, but the residual force along the motion rises from "
        f"{force.before:.3g} to {force.after:.3g} N RMS: the laws fit the motion, not the force. "
        "Compare the force with a load cell before it is used.",
    )


def _notes_of_search(
    problem: Problem, search: SearchResult, laws: Sequence[LawFound], *, by_blocks: bool
) -> tuple[str, ...]:
    """What was assumed or removed, and what the chosen model cannot be told from."""
    notes = [*problem.assumptions]
    if outliers := sum({grid.recording: grid.outliers for grid in problem.grids}.values()):
        notes.append(f"{outliers} heights are outliers and were removed.")
    if search.gain_alike:
        notes.append(
            "In these data a gain of the applied force is indistinguishable from a change of mass, "
            "stiffness and damping in one proportion. Weigh the mass to separate the two."
        )
    has_mass = any(p.kind == "mass" for p in free_parameters(problem, search.chosen.fit))
    if has_mass and problem.is_driven_by_force and not search.gain_alike:
        notes.append(
            "The intervals assume that the scale of the applied force is right: where that is "
            "wrong by 1 %, masses, stiffnesses, damping and forces are, too."
        )
    notes += _notes_of_tolerances(problem, search.chosen.fit, laws)
    if _resembles_hold(problem, search.chosen.fit):
        notes.append(
            "The delay is half a sampling interval, which a zero-order hold of the applied force "
            "causes. If the bench has such a hold, its applied force is not late."
        )
    if by_blocks:
        notes.append(
            "No run was held out: blocks spread over the recordings took no part in the search; "
            "the initial states are those of the fit."
        )
    return tuple(notes)


def _notes_of_zero_and_gain(problem: Problem, estimates: FitEstimates) -> tuple[str, ...]:
    """Corrections of the model that a wrong zero or gain of a channel would cause as well."""
    notes: list[str] = []
    is_dyno = problem.bench == "motion_given"
    free, implied = (
        free_parameters(problem, estimates.fit),
        find_preload_of_springs(problem, estimates),
    )
    if any(p.kind == "preload" and i not in implied for i, p in enumerate(free)):
        channel = "the load cell" if is_dyno else "the applied force or the height"
        notes.append(
            f"A preload has the same effect as a wrong zero of {channel}: check the zero before "
            "the preload is believed."
        )
    shares: dict[int, list[tuple[float, float]]] = {}
    for variable, p in enumerate(free if is_dyno else ()):
        if p.kind in ("stiffness", "damping") and p.nominal > 0.0:
            value = float(estimates.fit.solution.values[variable])
            half = float(estimates.covariance.half[variable]) * p.deviation
            shares.setdefault(p.strut, []).append((value / p.nominal, half / p.nominal))
    for strut, found in shares.items():
        if len(found) == 2 and abs(found[0][0] - found[1][0]) < max(
            found[0][1] + found[1][1], _LIKE
        ):
            share = float(np.mean([item for item, _ in found]))
            notes.append(
                f"Stiffness and damping of strut {problem.spec.struts[strut].name} differ by the "
                f"same share ({100.0 * share:+.2g} %): a load cell whose gain is wrong by it has "
                "the same effect."
            )
    return tuple(notes)


def _notes_of_tolerances(problem: Problem, result: Fit, laws: Sequence[LawFound]) -> list[str]:
    """Corrections that are far beyond the accuracy that the model file states, or a usual one.

    A preload that an edge decides which was not reached is not known.
    """
    notes: list[str] = []
    is_open = {law.strut for law in laws if any(edge.force_n_per_m for edge in law.unreached)}
    for parameter, change in zip(problem.linear, result.parts.linear, strict=True):
        if parameter.kind == "preload" and parameter.strut in is_open:
            continue
        times, key = abs(float(change)) / parameter.deviation, PARAMETERS[parameter.kind]
        is_stated = getattr(problem.spec.tolerance, key, None) is not None
        if times > (_FAR if is_stated else IMPROBABLE):
            known = "that the model file states" if is_stated else "of usual model files"
            notes.append(
                f"The correction of {key} is {times:.2g} times the standard deviation {known}: is "
                "its value right, and do the effects describe the strut?"
            )
    return notes


def _notes_of_channels(channels: Sequence[ChannelCorrection]) -> tuple[str, ...]:
    """What to do about a late channel, or one with a wrong gain."""
    notes: list[str] = []
    for item in channels:
        if not item.is_wrong:
            continue
        if item.parameter == PARAMETERS["height_gain"]:
            notes.append(
                f"{item.channel} shows {item.total.value:.4g} times the motion that is consistent "
                "with the measured motion of the base and with the other heights: correct its "
                "scaling (in the DBC or the mapping). The corrected model does not contain it."
            )
            continue
        if item.total.value > 0.0:
            what = f"state `delay_s: {item.total.value:.3g}` for it"
        else:
            what = (
                f"it is early, so state `delay_s: {-item.total.value:.3g}` for the channel that it "
                "is compared with"
            )
        notes.append(
            f"{item.channel} is not simultaneous: {what} in the configuration of the bench. The "
            "corrected model does not contain it."
        )
    return tuple(notes)


def _notes_of_bounds(problem: Problem, estimates: FitEstimates) -> tuple[str, ...]:
    """Parameters of laws at the end of the range in which they are searched, other than zero."""
    fit = estimates.fit
    names = [problem.existing[index].name for index in fit.candidate.kept]
    names += [name for _, name in fit.candidate.new]
    notes: list[str] = []
    for row, variables in effect_variables(problem, fit).items():
        law = effect(names[row])
        for variable, parameter in zip(variables.tolist(), law.parameters, strict=True):
            end, estimate = estimates.end_of_range(variable), estimates.estimate(variable)
            if end is not None and estimate.low is not None:
                text = f"{estimate.value:.3g} {parameter.unit}".rstrip()
                notes.append(
                    f"{parameter.name} of {law.name} is at the {end} end of its range "
                    f"({text}): the data may require a value beyond it, and its interval is open "
                    "there."
                )
    return tuple(notes)


def _notes_of_edges(problem: Problem, laws: Sequence[LawFound]) -> tuple[str, ...]:
    """Edges of play and stops that the motion did not reach."""
    notes: list[str] = []
    for law in laws:
        for edge in law.unreached:
            which, beyond = ("upper", "above") if edge.side > 0 else ("lower", "below")
            notes.append(
                f"The {which} edge of {law.name} of strut {problem.spec.struts[law.strut].name} "
                f"was not reached: it is at {edge.nearest_m:.4g} m or {beyond}. A run with "
                f"{effect(law.name).excitation} shows it."
            )
    return tuple(notes)


def _notes_of_standstill(
    problem: Problem, after: Sequence[ResidualForces | None]
) -> tuple[str, ...]:
    """Where the force that remains is that of rests and holds, during which friction creeps."""
    notes: list[str] = []
    known = [forces for forces in after if forces is not None]
    for index, strut in enumerate(problem.spec.struts):
        if not known:
            break
        force_n = np.concatenate([forces.force_n[index] for forces in known])
        rests = np.concatenate(
            [find_rests(f.track.t_s, np.abs(f.track.velocities_m_per_s[index])) for f in known]
        )
        is_known = np.isfinite(force_n)
        if not is_known.any():
            continue
        force_n, rests = force_n[is_known], rests[is_known]
        if not _LEAST_REST < float(np.mean(rests)) < 1.0 - _LEAST_REST:
            continue
        at_rest_n, moving_n = rms(force_n[rests]), rms(force_n[~rests])
        if at_rest_n > _MOSTLY * moving_n:
            notes.append(
                f"The force that remains in strut {strut.name} is {at_rest_n:.3g} N RMS at "
                f"standstill ({float(np.mean(rests)):.0%} of the time) and {moving_n:.3g} N in "
                "motion: during rests and holds the way in which friction creeps decides. A "
                "recording of motion alone evaluates the other laws better."
            )
    return tuple(notes)


def find_rests(t_s: Array, speed_m_per_s: Array) -> NDArray[np.bool_]:
    """Samples at which a strut stands still, all of shape (N,): not those of a turning point."""
    is_slow = speed_m_per_s < _STANDSTILL * float(np.quantile(speed_m_per_s, 0.95))
    for stretch in find_stretches(is_slow):
        if t_s[stretch][-1] - t_s[stretch][0] < _SHORTEST_REST_S:
            is_slow[stretch] = False
    return is_slow


def _notes_of_friction_like_laws(
    problem: Problem, result: Fit, after: Sequence[ResidualForces | None]
) -> tuple[str, ...]:
    """Laws of dampers whose force is that of dry friction along the recordings."""
    candidate = result.candidate
    names = [problem.existing[index].name for index in candidate.kept]
    names += [name for _, name in candidate.new]
    tracks = [(k, forces.track) for k, forces in enumerate(after) if forces is not None]
    if not tracks:
        return ()
    notes: list[str] = []
    for name, (strut, force) in zip(
        names, forces_along(problem, result.model, tracks), strict=True
    ):
        velocity = np.concatenate([track.velocities_m_per_s[strut] for _, track in tracks])
        friction_n = find_friction_n(force, velocity)
        if effect(name).family == "nonlinear_damping" and friction_n is not None:
            notes.append(
                f"{name} of strut {problem.spec.struts[strut].name} acts as dry friction of "
                f"{friction_n:.3g} N along these runs: its knee is below nearly all speeds."
            )
    return tuple(notes)


def find_friction_n(force_n: Array, velocity_m_per_s: Array) -> float | None:
    """Dry friction in N that a force is along a motion, both of shape (n,); None if it is none."""
    direction = np.sign(velocity_m_per_s)
    friction_n = -float(np.mean(force_n * direction))
    is_friction = rms(force_n + friction_n * direction) <= _FRICTION_LIKE * rms(force_n)
    return friction_n if is_friction and friction_n > 0.0 else None


def _resembles_hold(problem: Problem, result: Fit) -> bool:
    """Whether there is a delay that a zero-order hold of the applied force would cause."""
    half_s = 0.5 * problem.motions[0].step_s
    return any(
        p.kind == "delay" and abs(float(change) / half_s - 1.0) < _HOLD
        for p, change in zip(problem.linear, result.parts.linear, strict=True)
    )
