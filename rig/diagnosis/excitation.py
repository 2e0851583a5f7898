"""An excitation that shows what recordings leave open, within the stroke that they visited.

Three parts: slow cycles across the stroke, in which friction, springs and stops act alone; a sweep
through the resonance at a third of it; and a multisine at all of it. Together they have both
directions, amplitudes that differ by three, speeds from a creep to the fastest that were recorded,
and frequencies below and above the resonance. The motion is planned; the force that it takes is
that of the model (inverse dynamics).

References:
    Pintelon, Schoukens, System Identification: A Frequency Domain Approach (2012), 5.
    Swevers, Verdonck, De Schutter, Dynamic model identification for industrial robots, IEEE Control
    Systems 27 (2007): a motion within limits is planned, not a force.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.plant import DartPlant
from dart_model.spec import ModelSpec
from rig.closed_loop.strut_response import linearise_at
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.mechanism import mechanism_along, open_plants
from rig.recordings.recording import Recording, RecordingError

Array = NDArray[np.float64]

_REACH = 0.7
"""Share of the recorded stroke: at its resonance the bench moves farther than a rough model."""
_SLOW = 0.1
"""Frequency of the slow cycles, as a share of the resonance: the damper's force is small."""
_SLOW_CYCLES = 2
"""The second one shows what repeats: creep and noise do not."""
_SWEEP = (0.25, 3.0)
"""Ends of the sweep, as shares of the resonance."""
_SMALLER = 1.0 / 3.0
"""Amplitude of the sweep, as a share of that of the others."""
_TONES = 12
"""Tones of the multisine, evenly spaced between half and twice the resonance."""
_CYCLES = 20.0
"""Cycles at the resonance that the sweep and the multisine each last."""
_LONGEST_S = 60.0
"""Longest part."""
_FADE = 0.1
"""Share of a part in which it fades in, and out."""
_MOST_HZ = 1000.0
"""Most samples a second: the fastest rate of a bridge on an ordinary Linux."""
_SAMPLES = 40.0
"""Samples in a cycle of the fastest part, at least."""


class Excitation(NamedTuple):
    """What drives a bench, over time.

    Attributes:
        column: ``applied_force_n``, or on a dyno ``height_m``.
        values: In N or m, shape (N,).
        heights_m: The planned motion, shape (N,).
    """

    t_s: Array
    column: str
    values: Array
    heights_m: Array


def plan_excitation(spec: ModelSpec, recordings: Sequence[Recording]) -> Excitation:
    """Plan an excitation for a bench of one strut, about the stroke of its recordings.

    Raises:
        RecordingError: The bench has more struts, or is driven by more than one force.
    """
    if len(spec.struts) != 1:
        raise RecordingError(
            f"model {spec.name}: {len(spec.struts)} struts, expected one: an excitation is planned "
            "for a bench of one strut"
        )
    is_dyno = all(not recording.inputs for recording in recordings)
    if not is_dyno and any(recording.applied_force_n is None for recording in recordings):
        raise RecordingError(
            f"{recordings[0].name}: expected a bench that one applied force drives, or a dyno"
        )
    heights = np.concatenate([recording.heights_m[:, 0] for recording in recordings])
    low_m, high_m = float(np.nanmin(heights)), float(np.nanmax(heights))
    plant = DartPlant(spec)
    resonance_hz = _resonance_hz(plant, spec, 0.5 * (low_m + high_m))
    step_s = 1.0 / min(_MOST_HZ, _SAMPLES * _SWEEP[1] * resonance_hz)
    t_s, shape = _shape(resonance_hz, step_s)
    z = 0.5 * (low_m + high_m) + 0.5 * _REACH * (high_m - low_m) * shape
    if is_dyno:
        # A machine has a fastest speed: the motion is slowed down as a whole.
        top = max(_top_speed(recording) for recording in recordings)
        slower = max(1.0, float(np.abs(np.gradient(z, step_s)).max()) / top)
        return Excitation(t_s * slower, "height_m", z, z)
    return Excitation(t_s, "applied_force_n", _needed_forces(spec, t_s, z), z)


def _shape(resonance_hz: float, step_s: float) -> tuple[Array, Array]:
    """Times, and the planned motion as a share of half its stroke, each (N,)."""
    slow_s = _SLOW_CYCLES / (_SLOW * resonance_hz)
    fast_s = min(_CYCLES / resonance_hz, _LONGEST_S)
    slow = _times(min(slow_s, _LONGEST_S), step_s)
    fast = _times(fast_s, step_s)
    first_hz, last_hz = (share * resonance_hz for share in _SWEEP)
    rate = np.log(last_hz / first_hz) / fast_s
    sweep = np.sin(2.0 * np.pi * first_hz * np.expm1(rate * fast) / rate)
    tones_hz = resonance_hz * np.linspace(0.5, 2.0, _TONES)
    # Schroeder's phases keep the peak low.
    phases = -np.pi * np.arange(_TONES) * (np.arange(_TONES) - 1) / _TONES
    multisine = np.sum(np.cos(2.0 * np.pi * np.outer(fast, tones_hz) + phases), axis=1)
    multisine /= np.abs(multisine).max()
    cycles = np.sin(2.0 * np.pi * _SLOW_CYCLES * slow / slow[-1])
    parts = (cycles, _SMALLER * sweep, multisine)
    shape = np.concatenate([part * _fade(len(part)) for part in parts])
    return np.asarray(step_s * np.arange(len(shape)), np.float64), shape


def _times(duration_s: float, step_s: float) -> Array:
    return np.asarray(step_s * np.arange(round(duration_s / step_s) + 1), np.float64)


def _fade(count: int) -> Array:
    """Weights (count,) that rise from zero and fall to it, with continuous second derivatives."""
    edge = np.clip(np.minimum(np.arange(count), np.arange(count)[::-1]) / (_FADE * count), 0.0, 1.0)
    return edge**3 * (10.0 - 15.0 * edge + 6.0 * edge**2)


def _top_speed(recording: Recording) -> float:
    """Largest speed of a recording, noise smoothed over a hundredth of it."""
    known = np.isfinite(recording.heights_m[:, 0])
    t_s, z = recording.t_s[known], recording.heights_m[known, 0]
    width = max(1, len(z) // 100)
    smooth = np.convolve(z, np.ones(width) / width, mode="valid")
    return float(np.abs(np.gradient(smooth, t_s[: len(smooth)])).max())


def _resonance_hz(plant: DartPlant, spec: ModelSpec, height_m: float) -> float:
    mobility = float(linearise_at(plant, [height_m]).mobility_per_kg[0, 0])
    stiffness = max(spec.struts[0].stiffness_n_per_m, 1e-9)
    return float(np.sqrt(stiffness * mobility)) / (2.0 * np.pi)


def _needed_forces(spec: ModelSpec, t_s: Array, z: Array) -> Array:
    """Applied force (N,) that a motion of the strut takes, by its linear spring and damper."""
    (strut,), plants = spec.struts, open_plants(spec)
    w = np.asarray(np.gradient(z, t_s), np.float64)
    a = np.asarray(np.gradient(w, t_s), np.float64)
    height, velocity, acceleration = (row[:, np.newaxis] for row in (z, w, a))
    still = np.zeros((len(z), plants.plain.inputs))
    along = Track.of_columns(t_s, height, velocity, np.zeros_like(z), np.zeros_like(z))
    m = mechanism_along(plants, along, still)
    unmoved = np.zeros((len(z), 2, 1))
    needed_n = m.strut_forces_of_motion(height, velocity, acceleration, still, unmoved)[:, 0]
    own_n = -strut.stiffness_n_per_m * (z - strut.free_length_m) - strut.damping_n_s_per_m * w
    # A unit of the applied force, as a force in the strut.
    per_newton = m.inputs[:, 0, 0] / m.jacobian[:, 0, 0]
    return np.asarray((needed_n - own_n) / per_newton, np.float64)
