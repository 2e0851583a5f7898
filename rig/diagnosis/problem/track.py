"""Laws along a known motion."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import Motion, effect
from rig.diagnosis.numerics.compiled import LawValues, StrutMotion, force_along
from rig.diagnosis.problem.problem import (
    Candidate,
    Parts,
    Problem,
    Segment,
    Track,
    placed,
    slots_of,
    strut_constants,
)

Array = NDArray[np.float64]

_LONGEST_STATE_STEP_S = 0.6e-3
"""Longest step of an internal state along a motion: a bristle that settles at 2000 1/s needs it."""
_MOST_STATE_STEPS = 8
_PIECES = 8
"""Parts of recordings that are too long for all of them to be looked at; one of each at least."""
_TURN = 0.5
"""Most that the fastest motion turns between samples: a cubic through heights and velocities then
errs by less than a thousandth."""
_NO_STATE = np.zeros(0)


def _substeps(t_s: Array) -> int:
    """Steps of an internal state between the samples of a track."""
    step = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    return int(np.clip(np.ceil(step / _LONGEST_STATE_STEP_S), 1, _MOST_STATE_STEPS))


def most_thinned(motions: Sequence[Motion]) -> int:
    """Of how many samples one may be kept so that a motion is still known between them."""
    return max(
        1, min(int(_TURN * 0.5 * m.stroke_m / (m.top_speed_m_per_s * m.step_s)) for m in motions)
    )


def pieces(nodes: int, samples: int, most: int, most_thinned: int) -> list[slice]:
    """Parts of a recording that are looked at.

    Args:
        nodes: Nodes of the recording.
        samples: Nodes of all recordings.
        most: Nodes of all that are looked at.
        most_thinned: Of how many nodes one may be kept; where that leaves more, pieces are spread
            over the recording.
    """
    step = max(1, min(round(samples / most), most_thinned))
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
    """Force (N,) of a law along a motion.

    Args:
        track: The motion.
        strut: Index of the strut.
        name: Name of the effect.
        values: Its parameters.
        constants: Free length, stiffness, damping and gravity of all struts, shape (struts, 4...).
        state: Internal state at the beginning; at zero if absent.
    """
    start = state if len(state) else np.zeros(effect(name).state_size)
    motion = StrutMotion(
        track.t_s, track.heights_m[strut], track.velocities_m_per_s[strut],
        track.applied_n, track.temperature_c,
    )  # fmt: skip
    own = LawValues(np.ascontiguousarray(values), constants[strut], start)
    return force_along(name, own, motion, _substeps(track.t_s))


def linear_forces(tracks: Sequence[Track], strut: int) -> Array:
    """An orthonormal basis of a strut's linear forces along motions one after another.

    Returns:
        Of a constant force, a spring's and a damper's, shape (N, 3).
    """
    heights_m = np.concatenate([track.heights_m[strut] for track in tracks])
    velocities = np.concatenate([track.velocities_m_per_s[strut] for track in tracks])
    columns = np.column_stack([np.ones_like(heights_m), heights_m, velocities])
    return np.asarray(np.linalg.qr(columns)[0], dtype=np.float64)


def segment_forces(
    segments: Sequence[Segment],
    strut: int,
    name: str,
    values: Array,
    constants: Array,
    *,
    reference: bool,
) -> list[Array]:
    """Force (N,) of a law along each segment; internal states come from the whole recordings.

    Args:
        segments: The segments.
        strut: Index of the strut.
        name: Name of the effect.
        values: Its parameters.
        constants: Strut constants.
        reference: Along the reference's motion, not the measured one.
    """
    found: list[Array] = []
    known: dict[int, Array] = {}
    for segment in segments:
        own = segment.reference if reference else segment.track
        if segment.lead is None or effect(name).state_size == 0:
            found.append(law_force(own, strut, name, values, constants))
            continue
        whole = segment.lead[1] if reference else segment.lead[0]
        if id(whole) not in known:
            known[id(whole)] = law_force(whole, strut, name, values, constants)
        found.append(np.interp(own.t_s, whole.t_s, known[id(whole)]))
    return found


def effect_forces(
    problem: Problem, candidate: Candidate, parts: Parts, track: Track, states: Array
) -> list[tuple[int, Array]]:
    """Strut and force (N,) of each effect of a candidate along a motion."""
    constants = strut_constants(problem, parts.linear)
    slots = slots_of(problem, candidate).each
    return [
        (
            strut,
            law_force(
                track, strut, name, parts.effects[slot.parameters], constants,
                states[slot.states],
            ),
        )
        for (strut, name), slot in zip(placed(problem, candidate), slots, strict=True)
    ]  # fmt: skip


def forces_along(
    problem: Problem, candidate: Candidate, parts: Parts, tracks: Sequence[tuple[int, Track]]
) -> list[tuple[int, Array]]:
    """Strut and force of each effect over recordings, given by index and motion, in their order."""
    each = [
        effect_forces(problem, candidate, parts, track, problem.states(k, candidate, parts))
        for k, track in tracks
    ]
    return [
        (rows[0][0], np.concatenate([force for _, force in rows]))
        for rows in zip(*each, strict=True)
    ]


def strut_forces(
    problem: Problem, candidate: Candidate, parts: Parts, track: Track, states: Array
) -> Array:
    """Force of every strut of a model along a motion, shape (struts, N)."""
    constants = strut_constants(problem, parts.linear)
    free, stiffness, damping, preload = constants[:, [0, 1, 2, 4], np.newaxis].transpose(1, 0, 2)
    total = preload - stiffness * (track.heights_m - free) - damping * track.velocities_m_per_s
    for strut, force in effect_forces(problem, candidate, parts, track, states):
        total[strut] += force
    return total
