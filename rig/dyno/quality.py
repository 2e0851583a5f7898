"""Warnings about a record that may mislead, in words."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from rig.dyno.corrections import Corrections
from rig.dyno.figures import SIDES, DynoStep, ForceRecord
from rig.dyno.sensor_faults import SensorFaults
from rig.dyno.stroke_force import FINE, MeanStroke
from rig.dyno.strokes import Array
from rig.dyno.timeline import Span, words
from rig.recordings.clipping import find_sudden_plateaus

_GAP = 2.5
"""Times the usual time between samples: one is missing at least, however the clock jitters."""

_FEW_A_CYCLE = 16.0
"""Samples of a cycle below which a stroke has hardly eight: its shape is mostly the spline's."""

_COARSE = 2.0
"""Steps of a channel over its noise from which on the steps are what is seen."""


_PARTS = 72
"""Parts of a stroke whose samples' means are compared with the mean curve: 2.5 degrees each."""

_LEFT = 0.1
"""Share of a stroke's range of force by which a mean curve may leave its samples: good dampers stay
below 0.06 (where friction reverses), free play of 0.5 mm leaves 0.2, a knock of 1 mm above 1."""

_CERTAIN = 5.0
"""Standard deviations of a part's mean that such a difference has at least."""


def quality(
    record: ForceRecord,
    steps: Sequence[DynoStep],
    spans: Sequence[Span],
    faults: SensorFaults,
    corrections: Corrections,
) -> tuple[str, ...]:
    """Warnings of gaps, few samples, coarse steps, a wrong sign, drift, poor fits, what is unused.

    `spans` account for the whole record, `faults` are those of its sensors, and `corrections` what
    was done about drift and lag.
    """
    t_s, force_n = record.t_s, record.force_n
    return (
        *_sign(steps),
        *faults.words(),
        *corrections.words(),
        *(words(span) for span in spans if span.use == "rejected"),
        *preflight(t_s, {"height": record.height_m}),
        *_few_samples(t_s, steps),
        *_coarse(force_n),
        *_left_samples(steps),
    )


def preflight(t_s: Array, channels: Mapping[str, Array]) -> tuple[str, ...]:
    """Warnings of gaps, and of channels that were clipped at an end of their range.

    Times increase, shape (N,); each channel has the same shape, and NaN where there is no value.
    """
    clipped = [
        f"{name} stays at its {plateau.extreme} value {plateau.limit:.6g}, "
        f"{len(plateau.firsts)} times: clipped?"
        for name, values in channels.items()
        for plateau in find_sudden_plateaus(values[np.isfinite(values)])
    ]
    return (*_gaps(t_s), *clipped)


def _sign(steps: Sequence[DynoStep]) -> Iterator[str]:
    giving = [step for step in steps if step.energy_per_cycle_j.high < 0.0]
    if giving:
        step = min(giving, key=lambda item: item.energy_per_cycle_j.value)
        yield (
            f"the strut gives energy, {-step.energy_per_cycle_j.value:.3g} J a cycle at "
            f"{step.peak_speed_m_per_s:.3g} m/s, which no damper does: is the sign of its force "
            "right (`rig import --rebound`)?"
        )


def _gaps(t_s: Array) -> Iterator[str]:
    apart = np.diff(t_s)
    gaps = np.flatnonzero(apart > _GAP * float(np.median(apart)))
    if len(gaps):
        longest = int(gaps[np.argmax(apart[gaps])])
        yield (
            f"{len(gaps)} gaps between samples, the longest {apart[longest]:.3g} s at "
            f"{t_s[longest]:.3f} s"
        )


def _few_samples(t_s: Array, steps: Sequence[DynoStep]) -> Iterator[str]:
    usual_s = float(np.median(np.diff(t_s)))
    counts = [
        (1.0 / (step.frequency_hz * usual_s), step.peak_speed_m_per_s)
        for step in steps
        if step.frequency_hz is not None
    ]
    count, speed = min(counts, key=lambda item: item[0], default=(_FEW_A_CYCLE, 0.0))
    if count < _FEW_A_CYCLE:
        yield (
            f"{count:.1f} samples a cycle at {speed:.3g} m/s: the shape of its strokes is a guess, "
            "and so are peaks between samples"
        )


def _coarse(force_n: Array) -> Iterator[str]:
    """A force whose steps are larger than its noise: the noise is then not white."""
    apart = np.abs(np.diff(force_n))
    levels = np.unique(np.round(apart[apart > 0.0], 9))
    if len(levels) < 2 or np.count_nonzero(apart == 0.0) < 0.2 * len(apart):
        return
    step = float(levels[0])
    noise = float(np.median(np.abs(np.diff(force_n, 2)))) / 0.6745 / 6.0**0.5
    if step >= _COARSE * max(noise, 1e-12):
        yield f"the force comes in steps of {step:.3g} N, more than its noise"


def _left_samples(steps: Sequence[DynoStep]) -> Iterator[str]:
    """The place where a mean curve leaves its samples most, if it leaves any by much."""
    worst_share, text = _LEFT, ""
    for step in steps:
        for side, stroke in zip(SIDES, step.strokes, strict=True):
            apart_n, angle = _largest_distance(stroke)
            share = abs(apart_n) / max(float(np.ptp(stroke.force_n)), 1e-300)
            if share > worst_share:
                worst_share = share
                at_mm = 1e3 * stroke.sign * stroke.amplitude_m * np.sin(angle)
                text = (
                    f"the mean curve of {side} at {step.peak_speed_m_per_s:.3g} m/s leaves its "
                    f"samples by {abs(apart_n):.3g} N at {at_mm:+.1f} mm from mid-stroke: a knock, "
                    "free play or another force that changes within a short travel"
                )
    if text:
        yield text


def _largest_distance(stroke: MeanStroke) -> tuple[float, float]:
    """Largest distance of the samples' means from the mean curve that is certain, and its angle."""
    part = np.arange(len(FINE)) * _PARTS // len(FINE)
    counts = np.bincount(part, stroke.samples, _PARTS)
    curve_n = stroke.row(FINE) @ stroke.force_n
    sums_n = np.bincount(part, stroke.sums_n - stroke.samples * curve_n, _PARTS)
    means_n = sums_n / np.maximum(counts, 1.0)
    is_certain = np.abs(means_n) * np.sqrt(counts) > _CERTAIN * stroke.noise_n
    at = int(np.argmax(np.abs(means_n) * is_certain))
    return float(means_n[at] * is_certain[at]), float(FINE[np.flatnonzero(part == at)].mean())
