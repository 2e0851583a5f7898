"""A record divided into strokes by direction of motion, and like strokes into blocks.

A stroke goes from one turning point of the height to the next. A turning point counts when the
height has left it by more than a share of the record's stroke and by more than its noise, so that
neither noise nor a tremor at rest makes strokes. Consecutive strokes of one amplitude, duration and
shape are a block: one step of a test. A stroke in which the machine rests on its way to another
step may have amplitude and duration of the others; its shape differs. What does not move for long
is a hold.

The motion of a block is a Fourier series where one fits to the noise, as for the usual sine
machines; else it is smoothed.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize_scalar  # pyright: ignore[reportUnknownVariableType]

from rig.diagnosis.numerics.smoother import estimate_noise, smooth
from rig.recordings.stretches import find_stretches

Array = NDArray[np.float64]

_TURN_SHARE = 0.02
"""Of the record's stroke: a reversal by less is no stroke."""

_TURN_NOISE = 8.0
"""Standard deviations of the noise by which a reversal is more than noise."""

_ALIKE = 0.15
"""Relative difference of amplitude or duration up to which strokes are of one block: machines keep
their steps within some per cent, and steps differ by a quarter and more."""

_SETTLED = 0.03
"""Relative difference from the median of a block up to which its first and last stroke are of it: a
machine that ramps up or down takes a stroke between two amplitudes."""

_SAME_SHAPE = 0.03
"""Of a stroke: standard deviation from the mean shape up to which strokes repeat one another."""

_SHAPE_POINTS = 41

_ODD_SHAPE = 0.03
"""Standard deviation of a stroke's shape from the usual one, as a share of its rise, from which on
it is another motion: a rest of a tenth of its duration makes 0.04."""

_TURN_SAMPLES = 1.0
"""Samples by which a turning point may be off: durations differ by twice as much, and of the shape
as large a share as of the stroke's samples."""

_ODD_NOISE = 3.0
"""Standard deviations of the height's noise that a shape may differ by."""

_SLOW_M_PER_S = 5e-3
"""Peak speed up to which a single cycle is a step: the force is then one of seal and gas alone."""

_HALF = 0.49
"""Of a stroke that is taken before and after the whole one of a single cycle: not all, because
the machine rests where it begins and ends."""

_SINGLE_SHARE = 0.03
"""Share of the stroke by which a single cycle may differ from a sine."""

_FEWEST_UNLIKE_A_SERIES = 4
"""Strokes of a motion that is no Fourier series: two of each direction, to hold against each other.
"""

_FEWEST_STROKES = 3
"""Of a block: a single stroke has no repetition, and one by which a machine gets there is none."""

_SHORTEST_HOLD_S = 0.5
"""Shortest hold."""

_STILL_SHARE = 1e-3
"""Of the record's stroke: a height that moves less within the shortest hold is at rest; of 50 mm
that is 0.1 mm/s, a fifth of the slowest step that machines run."""

_TAIL_SHARE = 0.02
"""Of what is still: by how much less the ends of a rest may be away from its middle."""

_BENT = 0.4
"""Range of the parabola through a rest over what is still, from which on it is a turning point: one
that passes for still rises by all of it, a rest with the ends of strokes next to it by a fifth."""

_FEWEST_AT_REST = 20
"""Samples of a hold: two for each of the batches whose means give its uncertainty."""

_MOST_HARMONICS = 6
"""Most harmonics of a block's motion; Akaike's criterion chooses how many."""

_SERIES_SHARE = 0.01
"""Residual of a series over the amplitude above which the motion is smoothed instead."""


_PER_CYCLE, _BETWEEN = 1441, 8
"""Points of a cycle, and of a sample of a motion without cycles, at which peaks are looked for."""


class Stroke(NamedTuple):
    """Samples `first` to `last`, the next turning point; the rise is positive in rebound."""

    first: int
    last: int
    rise_m: float
    duration_s: float


class BlockMotion(NamedTuple):
    """The motion of a block.

    Attributes:
        height_m: Height at the samples, shape (N,).
        velocity_m_per_s: Its rate at the samples, shape (N,).
        between_m: Height at and between the samples, over a cycle at least, shape (M,).
        between_m_per_s: Its rate there, shape (M,).
        velocity_std_m_per_s: Standard deviation of the largest rate.
        period_s: Time of a cycle; NaN where the motion is not periodic.
    """

    height_m: Array
    velocity_m_per_s: Array
    between_m: Array
    between_m_per_s: Array
    velocity_std_m_per_s: float
    period_s: float


class Block(NamedTuple):
    """Like strokes in a row, alternately up and down: samples from `begin` to before `end`.

    A single cycle has one whole stroke, and half a stroke before and after it.
    """

    strokes: tuple[Stroke, ...]
    begin: int
    end: int
    cycles: float

    @property
    def samples(self) -> slice:
        """Its samples in the record."""
        return slice(self.begin, self.end)


def find_strokes(t_s: Array, height_m: Array) -> list[Stroke]:
    """All strokes of a record: times, increasing, and heights, shape (N,)."""
    noise_m = standard_noise(height_m)
    low, high = np.percentile(height_m, (1.0, 99.0))
    least_m = max(_TURN_SHARE * float(high - low), _TURN_NOISE * noise_m)
    turns = list(_turns(height_m, least_m)) if least_m > 0.0 else []
    return [
        Stroke(a, b, float(height_m[b] - height_m[a]), float(t_s[b] - t_s[a]))
        for a, b in itertools.pairwise(turns)
    ]


def standard_noise(values: Array) -> float:
    """Standard deviation of the noise of a smooth channel, by its third differences."""
    return float(np.median(np.abs(np.diff(values, 3)))) / (0.6745 * np.sqrt(20.0))


def _turns(height_m: Array, least_m: float) -> Iterator[int]:
    """Turning points, each left by at least some height."""
    values = height_m.tolist()
    low = high = 0
    rising: bool | None = None
    for index, value in enumerate(values):
        if value > values[high]:
            high = index
        if value < values[low]:
            low = index
        if rising is not False and value < values[high] - least_m:
            yield high
            rising, low, high = False, index, index
        elif rising is not True and value > values[low] + least_m:
            yield low
            rising, low, high = True, index, index
    if rising is not None:
        yield high if rising else low


def find_blocks(t_s: Array, height_m: Array, strokes: list[Stroke]) -> list[Block]:
    """Blocks of a record: at least three like strokes in a row, or a single slow cycle.

    Times, increasing, and heights have the shape (N,).
    """
    runs = [
        _without_ramps(part)
        for run in _find_runs(strokes)
        for part in _split_by_shape(t_s, height_m, run)
    ]
    blocks = [Block(tuple(r), r[0].first, r[-1].last + 1, 0.5 * len(r)) for r in runs]
    used = {stroke.first for run in runs for stroke in run}
    singles = [
        single
        for stroke in strokes
        if stroke.first not in used
        if (single := _single_cycle(t_s, height_m, stroke)) is not None
    ]
    return sorted([*blocks, *singles], key=lambda block: block.begin)


def _find_runs(strokes: list[Stroke]) -> list[list[Stroke]]:
    """Strokes of one amplitude and duration in a row, three at least."""
    runs: list[list[Stroke]] = []
    run: list[Stroke] = []
    for stroke in [*strokes, Stroke(-1, -1, 0.0, 0.0)]:
        if run and not _is_alike(run, stroke):
            if len(run) >= _FEWEST_STROKES:
                runs.append(run)
            # A stroke that a machine changes its step in may have been like the next by chance.
            keeps = len(run) < _FEWEST_STROKES and _is_alike(run[-1:], stroke)
            run = run[-1:] if keeps else []
        run.append(stroke)
    return runs


def _split_by_shape(t_s: Array, height_m: Array, run: list[Stroke]) -> Iterator[list[Stroke]]:
    """Parts of a run between strokes whose shape is not the usual one, three strokes at least."""
    apart = np.zeros(len(run))
    for side in (slice(0, None, 2), slice(1, None, 2)):
        # As shares of the rise.
        shapes = np.array(
            [
                (_heights_along(t_s, height_m, stroke) - height_m[stroke.first]) / stroke.rise_m
                for stroke in run[side]
            ]
        )
        apart[side] = np.std(shapes - np.median(shapes, axis=0), axis=1)
    usual_m = float(np.median([abs(stroke.rise_m) for stroke in run]))
    samples = (run[-1].last - run[0].first) / len(run)
    noise = _ODD_NOISE * standard_noise(height_m) / usual_m
    largest = max(_ODD_SHAPE, _TURN_SAMPLES / samples, noise)
    parts = (run[alike] for alike in find_stretches(apart <= largest))
    yield from (part for part in parts if len(part) >= _FEWEST_STROKES)


def _heights_along(t_s: Array, height_m: Array, stroke: Stroke) -> Array:
    """Heights at even shares of the duration of a stroke, shape (41,)."""
    share = np.linspace(0.0, 1.0, _SHAPE_POINTS)
    at_s = t_s[stroke.first] + share * stroke.duration_s
    return np.asarray(np.interp(at_s, t_s, height_m), np.float64)


def find_slow_cycle(t_s: Array, height_m: Array, block: Block) -> Block | None:
    """The cycle about the middle stroke of a block, if it is a slow sine; else None.

    Of a few slow cycles between which the machine builds up its amplitude, one is whole.
    """
    return _single_cycle(t_s, height_m, block.strokes[len(block.strokes) // 2])


def _single_cycle(t_s: Array, height_m: Array, stroke: Stroke) -> Block | None:
    """A slow cycle of a sine about one whole stroke, with half a stroke before and after it."""
    if np.pi * abs(stroke.rise_m) / (2.0 * stroke.duration_s) > _SLOW_M_PER_S:
        return None
    begin_s = float(t_s[stroke.first]) - _HALF * stroke.duration_s
    end_s = float(t_s[stroke.last]) + _HALF * stroke.duration_s
    if begin_s < t_s[0] or end_s > t_s[-1]:
        return None
    begin, end = (int(i) for i in np.searchsorted(t_s, (begin_s, end_s)))
    middle_m = 0.5 * (height_m[stroke.first] + height_m[stroke.last])
    angle = np.pi * (t_s[begin:end] - t_s[stroke.first]) / stroke.duration_s
    sine_m = middle_m - 0.5 * stroke.rise_m * np.cos(angle)
    if float(np.abs(height_m[begin:end] - sine_m).max()) > _SINGLE_SHARE * abs(stroke.rise_m):
        return None
    return Block((stroke,), begin, end, 1.0)


def _without_ramps(run: list[Stroke]) -> list[Stroke]:
    """A run without strokes at its ends that a machine takes to get there, or back."""
    usual_m = float(np.median([abs(stroke.rise_m) for stroke in run]))
    kept = list(run)
    for end in (0, -1):
        while (
            len(kept) > _FEWEST_STROKES
            and abs(abs(kept[end].rise_m) - usual_m) > _SETTLED * usual_m
        ):
            kept.pop(end)
    return kept


def is_repetition(t_s: Array, height_m: Array, block: Block) -> bool:
    """Whether the strokes of a block are one motion again and again, and not alike by chance.

    Times and heights are those of the whole record, shape (N,).
    """
    if len(block.strokes) < _FEWEST_UNLIKE_A_SERIES:
        return False
    for side in (block.strokes[::2], block.strokes[1::2]):
        shapes = np.array([_heights_along(t_s, height_m, stroke) for stroke in side])
        apart = shapes - shapes.mean(axis=1, keepdims=True)
        usual_m = float(np.median([abs(stroke.rise_m) for stroke in side]))
        if float(np.std(apart - apart.mean(axis=0))) > _SAME_SHAPE * usual_m:
            return False
    return True


def _is_alike(run: list[Stroke], stroke: Stroke) -> bool:
    """Whether a stroke is like the last one of its direction, or returns as far."""
    last = run[-1]
    same_size = abs(abs(stroke.rise_m) - abs(last.rise_m)) <= _ALIKE * abs(last.rise_m)
    if not same_size or stroke.first != last.last:
        return False
    if len(run) == 1:
        return True
    before = run[-2]
    share = max(_ALIKE, 2.01 * _TURN_SAMPLES / (before.last - before.first))
    return abs(stroke.duration_s - before.duration_s) <= share * before.duration_s


def find_holds(t_s: Array, height_m: Array, blocks: list[Block]) -> list[slice]:
    """Samples at rest, one stretch between two blocks at the most."""
    ends = [0, *(edge for block in blocks for edge in (block.begin, block.end - 1)), len(t_s) - 1]
    usual_s = float(np.median(np.diff(t_s)))
    window = max(int(np.ceil(_SHORTEST_HOLD_S / usual_s)), _FEWEST_AT_REST)
    still_m = max(_STILL_SHARE * float(np.ptp(height_m)), _TURN_NOISE * standard_noise(height_m))
    holds: list[slice] = []
    for begin, end in zip(ends[::2], ends[1::2], strict=True):
        part = height_m[begin : end + 1]
        if len(part) < window:
            continue
        within = sliding_window_view(part, window)
        is_still = np.ptp(within, axis=1) <= still_m
        whole = t_s[begin + window - 1 : end + 1] - t_s[begin : end + 2 - window]
        is_still &= whole < 2.0 * window * usual_s  # and no samples are missing
        inside = np.flatnonzero(is_still)
        if not len(inside):
            continue
        runs = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1)
        stretches = [slice(begin + run[0], begin + run[-1] + window) for run in runs]
        rests = [rest for rest in stretches if not _turns_slowly(height_m[rest], still_m)]
        if rests:  # the longest without a break
            longest = max(rests, key=lambda rest: rest.stop - rest.start)
            holds.append(_trim(longest, height_m, still_m))
    return holds


def _trim(rest: slice, height_m: Array, still_m: float) -> slice:
    """A rest without the ends of the adjacent strokes."""
    apart = np.abs(height_m[rest] - np.median(height_m[rest]))
    inside = np.flatnonzero(apart <= max(_TAIL_SHARE * still_m, 4.0 * standard_noise(height_m)))
    return slice(rest.start + int(inside[0]), rest.start + int(inside[-1]) + 1)


def _turns_slowly(height_m: Array, still_m: float) -> bool:
    """Whether what looks like a rest is the turning point of a slow stroke: a parabola, or half."""
    position = np.linspace(-1.0, 1.0, len(height_m))
    curve = np.polynomial.Polynomial.fit(position, height_m, 2)(position)
    return float(np.ptp(curve)) > _BENT * still_m


def fit_motion(t_s: Array, height_m: Array, strokes: int) -> BlockMotion | None:
    """Height and velocity of a block, from its times and measured heights, shape (N,).

    None where they are neither a Fourier series nor can be smoothed.
    """
    series = _fourier_series(t_s - t_s[0], height_m, strokes)
    if series is not None:
        return series
    try:
        smoothed = smooth(t_s, height_m, estimate_noise(t_s, height_m))
    except np.linalg.LinAlgError:  # noise below what doubles resolve over a slow stroke
        return None
    height, velocity = smoothed.states[:, 0].copy(), smoothed.states[:, 1].copy()
    fine_s: Array = np.linspace(float(t_s[0]), float(t_s[-1]), _BETWEEN * len(t_s))
    curve = CubicHermiteSpline(t_s, height, velocity)
    between, rate = curve(fine_s), curve.derivative()(fine_s)
    # Positions in a stroke are relative to its middle, which may wander.
    height = height - _wander(t_s, t_s, height)
    between = between - _wander(fine_s, t_s, curve(t_s))
    std = float(np.median(smoothed.deviations[:, 1]))
    return BlockMotion(height, velocity, between, rate, std, float("nan"))


def _wander(at_s: Array, t_s: Array, height_m: Array) -> Array:
    """Deviation of the strokes' mid-position from its mean, m, shape (times,)."""
    strokes = find_strokes(t_s, height_m)
    if len(strokes) < _FEWEST_STROKES:
        return np.zeros_like(at_s)
    middles = [0.5 * (height_m[item.first] + height_m[item.last]) for item in strokes]
    times = [0.5 * (t_s[item.first] + t_s[item.last]) for item in strokes]
    # Two strokes, up and down, have one middle: each alone also has half of what it wanders.
    pairs = np.convolve(middles, (0.5, 0.5), "valid"), np.convolve(times, (0.5, 0.5), "valid")
    wandered = np.interp(at_s, pairs[1], pairs[0])
    return wandered - float(np.mean(pairs[0]))


def _fourier_series(t_s: Array, height_m: Array, strokes: int) -> BlockMotion | None:
    """A Fourier series through a block; None where the motion is none."""
    span_s = float(t_s[-1])
    per_cycle = 2.0 * len(t_s) / strokes
    harmonics = int(min(_MOST_HARMONICS, (per_cycle - 2.0) / 2.0))
    if harmonics < 1:
        return None
    coarse_hz = strokes / (2.0 * span_s)

    def misfit(frequency_hz: float, count: int) -> float:
        made = _harmonics(t_s, frequency_hz, count)
        residual_m = height_m - made @ _fit_columns(made, height_m)
        return float(residual_m @ residual_m)

    best, count, chosen = np.inf, 1, coarse_hz
    for tried in range(1, harmonics + 1):
        width = 0.35 / span_s
        minimum = minimize_scalar(
            misfit,
            bounds=(coarse_hz - width, coarse_hz + width),
            args=(tried,),
            method="bounded",
            options={"xatol": 1e-6 * coarse_hz},
        )
        value = len(t_s) * np.log(max(float(minimum.fun), 1e-30)) + 2.0 * (2 * tried + 2)
        if value < best:
            best, count, chosen = value, tried, float(minimum.x)
    made = _harmonics(t_s, chosen, count)
    weights = _fit_columns(made, height_m)
    fitted = made @ weights
    amplitude = 0.5 * float(np.ptp(fitted))
    if float(np.std(height_m - fitted)) > _SERIES_SHARE * amplitude:
        return None
    order = 2.0 * np.pi * chosen * np.arange(1, count + 1)
    rates = np.concatenate([[0.0], order * weights[1 + count :], -order * weights[1 : 1 + count]])
    rate = made @ rates
    fine = _harmonics(np.linspace(0.0, 1.0 / chosen, _PER_CYCLE), chosen, count)
    # Of the amplitudes, and of the frequency (Rife and Boorstyn, IEEE Trans. IT 20, 1974).
    freedom = max(len(t_s) - 2 * count - 2, 1)
    noise_m = float(np.linalg.norm(height_m - fitted)) / np.sqrt(freedom)
    size = np.sqrt(2.0 / len(t_s)) * noise_m
    # One harmonic more than were chosen, because its absence is uncertain too.
    more = 2.0 * np.pi * chosen * np.arange(1, count + 2)
    of_rates = size * float(np.linalg.norm(more))
    of_frequency = (
        np.sqrt(12.0) * size / span_s * float(np.max(np.abs(rate))) / order[0] / amplitude
    )
    std = float(np.hypot(of_rates, of_frequency))
    return BlockMotion(fitted, rate, fine @ weights, fine @ rates, std, 1.0 / chosen)


def _fit_columns(made: Array, height_m: Array) -> Array:
    """Weights of least squares, by the normal equations of nearly independent columns."""
    return np.asarray(np.linalg.lstsq(made.T @ made, made.T @ height_m, rcond=None)[0], np.float64)


def _harmonics(t_s: Array, frequency_hz: float, count: int) -> Array:
    """Columns of a Fourier series: one, cosines, sines."""
    phase = 2.0 * np.pi * frequency_hz * np.outer(t_s, np.arange(1, count + 1))
    return np.column_stack([np.ones_like(t_s), np.cos(phase), np.sin(phase)])
