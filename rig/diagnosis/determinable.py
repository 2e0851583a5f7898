"""What recordings can determine, before minutes are spent on a search.

Of each recording: samples, resolution, clipping, stroke, speeds, directions, frequencies. Of each
linear parameter: how well the motion determines it, by the Cramér-Rao bound. Of each family of
laws: the force from which on it would be found, and distinguished from its nearest rival, by the
response to its laws along the measured motion, linear part projected out.

References:
    Kay, Fundamentals of Statistical Signal Processing: Estimation Theory (1993), 3.
    Welch, The use of fast Fourier transform for the estimation of power spectra, IEEE Trans. Audio
    Electroacoust. 15 (1967).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from dart_model.effects import CATALOGUE, effect
from dart_model.spec import ModelSpec
from rig.diagnosis.evaluate import fit_as_given
from rig.diagnosis.numerics.blas import with_one_blas_thread
from rig.diagnosis.numerics.laws import compile_law
from rig.diagnosis.numerics.smoother import estimate_noise
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.channel_delays import SIGNIFICANT
from rig.diagnosis.problem.delay_estimate import LEAST_WIDTH_S, estimate_delays
from rig.diagnosis.problem.fmu_force import forces_along
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.linear_part import PARAMETERS
from rig.diagnosis.problem.problem import Problem, rms
from rig.diagnosis.problem.track import segment_forces, strut_forces
from rig.diagnosis.recording_bounds import (
    DelayBound,
    Determinable,
    FamilyBound,
    LinearBound,
    RecordingFacts,
)
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.screen import Stage, candidate_laws, law_starts, responses, stage_of
from rig.diagnosis.search.validity import smooth_tracks
from rig.recordings.recording import Recording
from rig.recordings.stretches import find_stretches

Array = NDArray[np.float64]

_SIDES = 0.05
"""Share of the power, or of the time, on either side of a band."""
_ALIKE = 0.98
"""Correlation of two estimates from which on they are hardly distinguished."""
_CLIPPED = 5
"""Samples in a row at an extreme that was reached at speed, from which on they are clipped."""
_AT_SPEED = 0.3
"""Speed, as a share of its RMS, with which an extreme is reached at speed."""


@with_one_blas_thread
def find_determinable(spec: ModelSpec, recordings: Sequence[Recording]) -> Determinable:
    """What recordings can determine of a model, and which laws it may lack.

    Bounds are those of a right model near the nominal one: a search does no better.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    problem = build_without_delays(spec, recordings, CRITERIA.blocks, None)
    given = fit_as_given(problem)
    stage = stage_of(problem, given.model)
    facts = [
        recording_facts(recording, strut.name, i)
        for recording in recordings
        for i, strut in enumerate(spec.struts)
    ]
    tracks = smooth_tracks(problem, given)
    along = [
        strut_forces(problem, given.model, track, problem.states(k, given.model))
        + _fmu_forces(problem, track)
        for k, track in tracks
    ]
    signals = [
        rms(np.concatenate([part[i] - part[i].mean() for part in along])) if along else np.nan
        for i in range(len(spec.struts))
    ]
    families = _family_bounds(stage.coarse or stage, signals)
    seen = {bound.family for bound in families}
    every = dict.fromkeys(effect(name).family for _, name in candidate_laws(problem))
    unexcited = tuple(family for family in every if family not in seen)
    gaps = tuple(run.gaps.report(run.name) for run in recordings if run.gaps)
    delays = _delay_bounds(problem)
    return Determinable(tuple(facts), _linear_bounds(stage), families, unexcited, delays, gaps)


def _fmu_forces(problem: Problem, track: Track) -> Array:
    """Forces of FMUs along a motion, shape (struts, N)."""
    forces_n = np.zeros_like(track.heights_m)
    for strut, mockup in enumerate(problem.plants.plain.mockups):
        if mockup is not None:
            forces_n[strut], _, _ = forces_along(mockup, strut, track)
    return forces_n


def _delay_bounds(problem: Problem) -> tuple[DelayBound, ...]:
    estimates = estimate_delays(problem)
    return tuple(
        DelayBound(channel, delay_s, std_s, max(SIGNIFICANT * std_s, LEAST_WIDTH_S))
        for channel, (delay_s, std_s) in estimates.items()
    )


def recording_facts(recording: Recording, strut: str, index: int) -> RecordingFacts:
    """Facts of one strut of a recording."""
    t_s, heights_m = recording.t_s, recording.heights_m[:, index]
    is_known = np.isfinite(heights_m)
    t, z = t_s[is_known], heights_m[is_known]
    step_s = float(np.median(np.diff(t_s)))
    noise_m = float(np.sqrt(estimate_noise(t, z).variance))
    even_s = np.arange(t[0], t[-1], step_s)
    smooth_m = _low_pass(np.interp(even_s, t, z), noise_m, step_s)
    velocity = np.gradient(smooth_m, step_s)
    moving = np.abs(velocity) > _SIDES * float(np.sqrt(np.mean(velocity**2)))
    rising = velocity > 0.0
    way = float(np.sum(np.abs(velocity[moving])))
    steps = np.diff(np.unique(z))
    resolution_m = float(steps.min()) if len(steps) else 0.0
    return RecordingFacts(
        recording.name,
        strut,
        recording.duration_s,
        1.0 / step_s,
        1.0 - float(np.mean(is_known)),
        _clipped_share(z),
        float(z.min()),
        float(z.max()),
        _usual_speed(-velocity),
        _usual_speed(velocity),
        float(np.sum(velocity[moving & rising])) / max(way, 1e-300),
        _band_hz(velocity, step_s),
        noise_m,
        resolution_m if resolution_m > 0.5 * noise_m else None,
    )


def _low_pass(heights_m: Array, noise_m: float, step_s: float) -> Array:
    """Heights (N,) without the frequencies in which noise alone is left, by Wiener's filter."""
    centred = heights_m - np.linspace(heights_m[0], heights_m[-1], len(heights_m))
    spectrum = np.fft.rfft(centred)
    power = np.abs(spectrum) ** 2
    floor = noise_m**2 * len(heights_m)
    width = max(1, round(1.0 / step_s / 100.0))
    smooth = np.convolve(power, np.ones(2 * width + 1) / (2 * width + 1), mode="same")
    gain = np.clip(1.0 - 2.0 * floor / np.maximum(smooth, 1e-300), 0.0, 1.0)
    return np.asarray(np.fft.irfft(spectrum * gain, len(heights_m)) + heights_m - centred)


def _usual_speed(velocity: Array) -> float:
    """Speed in the positive direction that is exceeded in a twentieth of that time."""
    positive = velocity[velocity > 0.0]
    return float(np.quantile(positive, 1.0 - _SIDES)) if len(positive) else 0.0


def _band_hz(velocity: Array, step_s: float) -> tuple[float, float]:
    """Frequencies between which nine tenths of a velocity's power lie."""
    window = min(len(velocity), max(256, len(velocity) // 4))
    frequency, density = welch(velocity, 1.0 / step_s, nperseg=window)
    share = np.cumsum(density) / max(float(np.sum(density)), 1e-300)
    low, high = np.searchsorted(share, (_SIDES, 1.0 - _SIDES))
    return float(frequency[low]), float(frequency[min(high, len(frequency) - 1)])


def _clipped_share(heights_m: Array) -> float:
    """Share of heights that stay at an extreme at which they arrived at speed."""
    change = np.abs(np.diff(heights_m, prepend=heights_m[0]))
    usual = float(np.sqrt(np.mean(change**2)))
    clipped = 0
    for extreme in (heights_m.min(), heights_m.max()):
        for stretch in find_stretches(heights_m == extreme):
            samples = stretch.stop - stretch.start
            if samples >= _CLIPPED and change[stretch.start] > _AT_SPEED * usual:
                clipped += samples
    return clipped / len(heights_m)


def _linear_bounds(stage: Stage) -> tuple[LinearBound, ...]:
    problem, count = stage.problem, len(stage.counted)
    data = stage.nuisance[: len(stage.nuisance) - count]
    size = np.linalg.norm(data, axis=0)
    # A free length acts in laws alone, and what does not act is not determined.
    acts = size[:count] > 0.0
    kept = np.concatenate([acts, size[count:] > 0.0])
    scaled = data[:, kept] / size[kept]
    covariance = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12) / np.outer(size[kept], size[kept])
    covariance = covariance * _thinning(stage)
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    correlation = np.abs(covariance / np.maximum(np.outer(deviations, deviations), 1e-300))
    np.fill_diagonal(correlation, 0.0)
    named = [problem.linear[i] for i, there in zip(stage.counted, acts, strict=True) if there]
    bounds: list[LinearBound] = []
    for row, p in enumerate(named):
        others = correlation[row, : len(named)]
        nearest = int(np.argmax(others))
        other = named[nearest]
        bounds.append(
            LinearBound(
                problem.spec.struts[p.strut].name,
                PARAMETERS[p.kind],
                p.nominal,
                float(deviations[row]),
                p.deviation,
                PARAMETERS[other.kind] if others[nearest] >= _ALIKE else None,
            )
        )
    return tuple(bounds)


def _thinning(stage: Stage) -> float:
    """Share of the recordings' nodes that the regression takes."""
    problem = stage.problem
    nodes = sum(int(problem.fit_nodes(k).sum()) for k in range(problem.recordings))
    taken = sum(len(segment.track.t_s) for segment in stage.segments)
    return min(taken / max(nodes, 1), 1.0)


@dataclass(frozen=True)
class _Visible:
    """A law at a start: response per newton, of unit length, and that length."""

    family: str
    name: str
    direction: Array
    per_newton: float


@np.errstate(over="ignore", invalid="ignore")  # What overflows is left out.
def _visible_laws(stage: Stage) -> dict[int, list[_Visible]]:
    """Laws at their starts that act on the recordings, by strut."""
    found: dict[int, list[_Visible]] = {}
    problem, taken = stage.problem, _thinning(stage)
    for at in candidate_laws(problem):
        compile_law(at[1])
        starts = law_starts(problem, at, {})
        for start, column in zip(starts, responses(stage, at, starts).T, strict=True):
            forces = segment_forces(stage.segments, at, start, stage.constants, reference=False)
            force_n = rms(np.concatenate(forces))
            length = float(np.linalg.norm(column))
            if not (np.isfinite(length) and force_n > 0.0 and length > 0.0):
                continue
            per_newton = length / force_n / np.sqrt(taken)
            visible = _Visible(effect(at[1]).family, at[1], column / length, float(per_newton))
            found.setdefault(at[0], []).append(visible)
    return found


def _family_bounds(stage: Stage, signals_n: Sequence[float]) -> tuple[FamilyBound, ...]:
    """Bounds of each family, from the start of middling visibility among those of its laws."""
    needed = float(np.sqrt(CRITERIA.least_likelihood_gain))
    bounds: list[FamilyBound] = []
    for strut, laws in _visible_laws(stage).items():
        every = np.array([law.direction for law in laws])
        for family in dict.fromkeys(law.family for law in laws):
            own = sorted((it for it in laws if it.family == family), key=lambda it: it.per_newton)
            law = own[len(own) // 2]
            least_n = needed / law.per_newton
            others = np.array([it.family != family for it in laws])
            likeness = np.where(others, np.abs(every @ law.direction), 0.0)
            nearest = int(np.argmax(likeness))
            apart = float(np.sqrt(max(1.0 - likeness[nearest] ** 2, 0.0)))
            bounds.append(
                FamilyBound(
                    family,
                    stage.problem.spec.struts[strut].name,
                    least_n,
                    least_n / signals_n[strut],
                    laws[nearest].family if others.any() else None,
                    least_n / apart if apart > 0.0 else np.inf,
                    CATALOGUE[law.name].excitation,
                )
            )
    return tuple(sorted(bounds, key=lambda bound: bound.apart_n))
