"""Laws along a known motion."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import Motion, effect
from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.laws import force_along
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.problem import (
    CandidateModel,
    ExistingParameters,
    Problem,
    Segment,
    StrutEffect,
    slots_of,
    strut_constants,
    strut_effects,
)

Array = NDArray[np.float64]

_LONGEST_STATE_STEP_S = 0.6e-3
"""Longest step of an internal state along a motion: a bristle that settles at 2000 1/s needs it."""
_MOST_STATE_STEPS = 8
_PIECES = 8
"""Parts that are taken of recordings too long to be taken whole; one of each at least."""
_TURN = 0.5
"""Most that the fastest motion turns between samples: a cubic through heights and velocities then
errs by less than a thousandth."""
_NEGLIGIBLE = 1e-9
"""Share of the strut's force below which an existing effect does not act on the recordings."""
_NO_STATE = np.zeros(0)


def largest_stride(motions: Sequence[Motion]) -> int:
    """Largest number of samples of which one may be kept, the motion still known between them."""
    return max(
        1, min(int(_TURN * 0.5 * m.stroke_m / (m.top_speed_m_per_s * m.step_s)) for m in motions)
    )


def pieces(nodes: int, samples: int, most: int, largest_stride: int) -> list[slice]:
    """Parts of a recording that a computation takes.

    Args:
        nodes: Nodes of the recording.
        samples: Nodes of all recordings.
        most: Nodes of all recordings that are taken, about.
        largest_stride: Number of nodes of which one is kept at least; where that leaves more than
            `most`, pieces are spread over the recording.
    """
    step = max(1, min(round(samples / most), largest_stride))
    share = most * step * nodes / samples
    if nodes < 2.0 * share:
        return [slice(0, nodes, step)]
    count = max(1, round(_PIECES * nodes / samples))
    length = max(int(share / count), 2 * step)
    firsts = [int(k * (nodes - length) / max(count - 1, 1)) for k in range(count)]
    return [slice(first, first + length, step) for first in firsts]


def law_force(
    track: Track, strut: int, name: str, values: Array, constants: Array, state: Array = _NO_STATE
) -> Array:
    """Force (N,) of a law along a motion, from an internal state (zero if absent) on.

    `constants` are free length, stiffness, damping and gravity of all struts, shape (struts, 4...).
    """
    start = state if len(state) else np.zeros(effect(name).state_size)
    own = np.ascontiguousarray(values), constants[strut], start
    t_s, heights_m, velocities, *inputs = track
    motion = t_s, heights_m[strut], velocities[strut], *inputs
    # Internal states take shorter steps than the samples.
    step = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    substeps = int(np.clip(np.ceil(step / _LONGEST_STATE_STEP_S), 1, _MOST_STATE_STEPS))
    return force_along(name, own, motion, substeps)


def finite_law_force(
    track: Track, strut_effect: StrutEffect, values: Array, constants: Array
) -> Array:
    """The same of a law in its strut, from rest; zero (N,) where any of it is not finite."""
    force = law_force(track, *strut_effect, values, constants)
    return force if np.all(np.isfinite(force)) else np.zeros_like(force)


def linear_forces(tracks: Sequence[Track], strut: int) -> Array:
    """An orthonormal basis (N, 3) of constant, spring and damper force along motions in a row."""
    heights_m = np.concatenate([track.heights_m[strut] for track in tracks])
    velocities = np.concatenate([track.velocities_m_per_s[strut] for track in tracks])
    columns = np.column_stack([np.ones_like(heights_m), heights_m, velocities])
    return np.asarray(np.linalg.qr(columns)[0], dtype=np.float64)


def segment_forces(
    segments: Sequence[Segment],
    strut_effect: tuple[int, str],
    values: Array,
    constants: Array,
    *,
    reference: bool,
) -> list[Array]:
    """Force (N,) of a law along each segment; internal states come from the whole recordings.

    It is taken along the reference's motion or along the measured one.
    """
    strut, name = strut_effect
    forces: list[Array] = []
    lead_forces: dict[int, Array] = {}
    for segment in segments:
        own = segment.reference if reference else segment.track
        if segment.lead is None or effect(name).state_size == 0:
            forces.append(law_force(own, strut, name, values, constants))
            continue
        whole = segment.lead[1] if reference else segment.lead[0]
        if id(whole) not in lead_forces:
            lead_forces[id(whole)] = law_force(whole, strut, name, values, constants)
        forces.append(np.interp(own.t_s, whole.t_s, lead_forces[id(whole)]))
    return forces


def existing_effects(spec: ModelSpec, tracks: Sequence[Track]) -> tuple[ExistingParameters, ...]:
    """Effects of a model, and whether each acts along motions so that it can be refitted."""
    existing: list[ExistingParameters] = []
    constants = np.array(
        [
            (s.free_length_m, s.stiffness_n_per_m, s.damping_n_s_per_m, spec.gravity_m_per_s2)
            for s in spec.struts
        ]
    )
    for i, strut in enumerate(spec.struts):
        for item in strut.effects:
            values = tuple(item.values())
            spring = max(float(np.std(t.heights_m[i])) * strut.stiffness_n_per_m for t in tracks)
            is_delay = item.name == "delay"
            acting = is_delay or not (effect(item.name).linear or item.name == "restoring_surface")
            if acting and not is_delay:
                forces = [law_force(t, i, item.name, np.array(values), constants) for t in tracks]
                acting = any(float(np.max(np.abs(f))) > _NEGLIGIBLE * spring for f in forces)
            existing.append(ExistingParameters(i, item.name, values, acting))
    return tuple(existing)


def effect_forces(
    problem: Problem, model: CandidateModel, track: Track, states: Array
) -> list[tuple[int, Array]]:
    """Strut and force (N,) of each effect of a model along a motion."""
    candidate, parts = model
    constants = strut_constants(problem, parts.linear)
    slots = slots_of(problem, candidate).each
    forces: list[tuple[int, Array]] = []
    for (strut, name), slot in zip(strut_effects(problem, candidate), slots, strict=True):
        values, own_states = parts.effects[slot.parameters], states[slot.states]
        forces.append((strut, law_force(track, strut, name, values, constants, own_states)))
    return forces


def forces_along(
    problem: Problem, model: CandidateModel, tracks: Sequence[tuple[int, Track]]
) -> list[tuple[int, Array]]:
    """Strut and force of each effect over recordings, given by index and motion, in their order."""
    each = [effect_forces(problem, model, track, problem.states(k, model)) for k, track in tracks]
    return [
        (rows[0][0], np.concatenate([force for _, force in rows]))
        for rows in zip(*each, strict=True)
    ]


def force_beyond_spring(
    problem: Problem, model: CandidateModel, track: Track, states: Array
) -> Array:
    """Force of every strut without that of its linear spring and its preload, shape (struts, N)."""
    constants = strut_constants(problem, model.parts.linear)
    free, stiffness, preload = constants[:, [0, 1, 4], np.newaxis].transpose(1, 0, 2)
    spring = preload - stiffness * (track.heights_m - free)
    return strut_forces(problem, model, track, states) - spring


def strut_forces(problem: Problem, model: CandidateModel, track: Track, states: Array) -> Array:
    """Force of every strut of a model along a motion, shape (struts, N)."""
    constants = strut_constants(problem, model.parts.linear)
    free, stiffness, damping, preload = constants[:, [0, 1, 2, 4], np.newaxis].transpose(1, 0, 2)
    total = preload - stiffness * (track.heights_m - free) - damping * track.velocities_m_per_s
    for strut, force in effect_forces(problem, model, track, states):
        total[strut] += force
    return total
