"""What in a record may mislead, in words, before its figures are read."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rig.dyno.figures import DynoStep
from rig.dyno.stroke_force import Figure

Array = NDArray[np.float64]

_GAP = 2.5
"""Times the usual time between samples: one is missing at least, however the clock jitters."""

_CLIPPED_SAMPLES, _CLIPPED_STEPS = 4, 4.0
"""Samples in a row at the end of a range, and steps of the channel by which it comes there, from
which on it is cut off."""

_USED_SHARE = 0.8
"""Strokes that are of a step below which it is said: ramps between steps are some in a hundred."""

_FEW_A_CYCLE = 16.0
"""Samples of a cycle below which a stroke has hardly eight: its shape is mostly the spline's."""

_SAME_HEIGHT_M = 5e-4
"""By which rests of one height may differ: of a gas spring of 2 N/mm that is 1 N."""

_COARSE = 2.0
"""Steps of a channel over its noise from which on the steps are what is seen."""


def quality(
    t_s: Array,
    force_n: Array,
    steps: Sequence[DynoStep],
    rests: Sequence[tuple[float, float, Figure]],
    strokes: int,
) -> tuple[str, ...]:
    """Gaps, cycles of few samples, a coarse force, a wrong sign, what is left out, a drift at rest.

    Args:
        t_s: Times, shape (N,).
        force_n: Forces, shape (N,).
        steps: Steps of the test.
        rests: Beginning, height and force of each time at rest.
        strokes: How many strokes the record has.
    """
    first = preflight(t_s, {"force": force_n})
    said = [*first, *_few_samples(t_s, steps), *_coarse(force_n), *_drift(rests)]
    return (*_sign(steps), *_strokes_outside_steps(steps, strokes), *said)


def preflight(t_s: Array, channels: Mapping[str, Array]) -> tuple[str, ...]:
    """Gaps, and channels that were cut off at an end of their range.

    Args:
        t_s: Times, increasing, shape (N,).
        channels: Measured values by their names, each of shape (N,); NaN where there is none.
    """
    cut = [text for name, values in channels.items() for text in _clipped(name, values)]
    return (*_gaps(t_s), *cut)


def _clipped(name: str, values: Array) -> list[str]:
    """A channel that stays at its largest or smallest value, and comes there at a jump."""
    values = values[np.isfinite(values)]
    apart = np.abs(np.diff(values))
    if not np.any(apart):
        return []
    step = float(np.min(apart[apart > 0.0]))
    found: list[str] = []
    for end, what in ((float(values.max()), "largest"), (float(values.min()), "smallest")):
        at_end = np.concatenate([[0], (values == end).astype(np.int64), [0]])
        starts, stops = np.flatnonzero(np.diff(at_end) == 1), np.flatnonzero(np.diff(at_end) == -1)
        long = starts[(stops - starts >= _CLIPPED_SAMPLES) & (starts > 0)]
        # A flat top of a channel in steps is one step above its sides.
        if len(long) and float(np.median(apart[long - 1])) > _CLIPPED_STEPS * step:
            found.append(f"{name} stays at its {what} value {end:.6g}, {len(long)} times: clipped?")
    return found


def _sign(steps: Sequence[DynoStep]) -> list[str]:
    giving = [step for step in steps if step.energy_per_cycle.high < 0.0]
    if not giving:
        return []
    step = min(giving, key=lambda item: item.energy_per_cycle.value)
    return [
        f"the strut gives energy, {-step.energy_per_cycle.value:.3g} J a cycle at "
        f"{step.peak_speed_m_per_s:.3g} m/s, which no damper does: is the sign of its force right "
        "(`rig import --rebound`)?"
    ]


def _strokes_outside_steps(steps: Sequence[DynoStep], strokes: int) -> list[str]:
    used = sum(round(2.0 * step.cycles) for step in steps)
    if used >= _USED_SHARE * strokes:
        return []
    return [f"{strokes - used} of {strokes} strokes repeat nothing and are left out"]


def _gaps(t_s: Array) -> list[str]:
    apart = np.diff(t_s)
    gaps = np.flatnonzero(apart > _GAP * float(np.median(apart)))
    if not len(gaps):
        return []
    longest = int(gaps[np.argmax(apart[gaps])])
    return [
        f"{len(gaps)} gaps between samples, the longest {apart[longest]:.3g} s at "
        f"{t_s[longest]:.3f} s"
    ]


def _few_samples(t_s: Array, steps: Sequence[DynoStep]) -> list[str]:
    usual_s = float(np.median(np.diff(t_s)))
    counts = [
        (1.0 / (step.frequency_hz * usual_s), step)
        for step in steps
        if step.frequency_hz is not None
    ]
    few = [item for item in counts if item[0] < _FEW_A_CYCLE]
    if not few:
        return []
    count, step = min(few, key=lambda item: item[0])
    return [
        f"{count:.1f} samples a cycle at {step.peak_speed_m_per_s:.3g} m/s: the shape of its "
        "strokes is a guess, and so are peaks between samples"
    ]


def _coarse(force_n: Array) -> list[str]:
    """A force whose steps are larger than its noise: the noise is then not white."""
    apart = np.abs(np.diff(force_n))
    levels = np.unique(np.round(apart[apart > 0.0], 9))
    if len(levels) < 2 or np.count_nonzero(apart == 0.0) < 0.2 * len(apart):
        return []
    step = float(levels[0])
    noise = float(np.median(np.abs(np.diff(force_n, 2)))) / 0.6745 / 6.0**0.5
    if step < _COARSE * max(noise, 1e-12):
        return []
    return [f"the force comes in steps of {step:.3g} N, more than its noise"]


def _drift(rests: Sequence[tuple[float, float, Figure]]) -> list[str]:
    """Two rests at one height whose forces differ by more than both their intervals."""
    for place, (begin_s, height_m, force) in enumerate(rests):
        for later_s, later_m, later in rests[place + 1 :]:
            if abs(later_m - height_m) > _SAME_HEIGHT_M:
                continue
            if later.low > force.high or later.high < force.low:
                return [
                    f"the force at rest at {1e3 * height_m:.1f} mm changed by "
                    f"{later.value - force.value:+.3g} N from {begin_s:.1f} s to {later_s:.1f} s: "
                    "gas that warms, friction that holds another way, or a cell that drifts"
                ]
    return []
