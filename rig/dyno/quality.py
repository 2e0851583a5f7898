"""Warnings about a record that may mislead, in words."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np

from rig.dyno.figures import AtRest, DynoStep, ForceRecord
from rig.dyno.strokes import Array
from rig.recordings.clipping import find_sudden_plateaus

_GAP = 2.5
"""Times the usual time between samples: one is missing at least, however the clock jitters."""

_USED_SHARE = 0.8
"""Share of strokes in steps below which a warning is due: ramps between steps are few."""

_FEW_A_CYCLE = 16.0
"""Samples of a cycle below which a stroke has hardly eight: its shape is mostly the spline's."""

_SAME_HEIGHT_M = 5e-4
"""By which rests of one height may differ: of a gas spring of 2 N/mm that is 1 N."""

_COARSE = 2.0
"""Steps of a channel over its noise from which on the steps are what is seen."""


def quality(
    record: ForceRecord, steps: Sequence[DynoStep], holds: Sequence[AtRest], strokes: int
) -> tuple[str, ...]:
    """Warnings of gaps, few samples, a coarse force, a wrong sign, unused strokes, a drift at rest.

    `strokes` is the number of strokes of the record.
    """
    t_s, force_n = record.t_s, record.force_n
    return (
        *_sign(steps),
        *_strokes_outside_steps(steps, strokes),
        *preflight(t_s, {"force": force_n}),
        *_few_samples(t_s, steps),
        *_coarse(force_n),
        *_drift(holds),
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


def _strokes_outside_steps(steps: Sequence[DynoStep], strokes: int) -> Iterator[str]:
    used = sum(round(2.0 * step.cycles) for step in steps)
    if used < _USED_SHARE * strokes:
        yield f"{strokes - used} of {strokes} strokes do not repeat and are not used"


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


def _drift(holds: Sequence[AtRest]) -> Iterator[str]:
    """The first two rests at one height whose forces differ by more than both their intervals."""
    for earlier, later in combinations(holds, 2):
        before, after = earlier.force_n, later.force_n
        is_same_height = abs(later.height_m - earlier.height_m) <= _SAME_HEIGHT_M
        if is_same_height and (after.low > before.high or after.high < before.low):
            yield (
                f"the force at rest at {1e3 * earlier.height_m:.1f} mm changed by "
                f"{after.value - before.value:+.3g} N from {earlier.begin_s:.1f} s to "
                f"{later.begin_s:.1f} s: gas that warms, friction that holds another way, or a "
                "cell that drifts"
            )
            return
