"""How far a model's motion is from that of its bench, as the innovations show it.

The heights, and the positions of measured motions, are compared with the model before an observer
uses them, so that their noise is independent of the model's error: what the innovations vary by
beyond the noise is that error, whatever causes it (the observers' lag, or laws of other struts that
are wrong).

In blocks about as long as the observers' time constant, a straight line through the innovations of
each channel shows the errors of position and rate, and their third differences, which a smooth
error hardly has, show the noise. Each virtual sensor of a motion errs by these errors times its
gains. Its variance is their mean square over the last blocks less that of the noise, or the fading
square of an error that occurs now and then, and what the observers follow of the noise, which is in
the model and not in the innovations.

Reference: Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE TAC 15
(1970), for innovations that show what a filter lacks.
"""

import math
from collections.abc import Sequence
from operator import mul
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from dart_model.protocol import AnySensorReader
from rig.bridge.estimator import AnyEstimator, FollowedError
from rig.observers.protocol import Innovation

Array = NDArray[np.float64]

_AVERAGED = 64
"""Blocks over which squares are averaged: about a second of an observer with 20 Hz."""

_LARGEST_OF_NORMAL = 9.0
"""Square that normal errors hardly ever show, over its mean: three standard deviations."""

_FEWEST = 4
"""Innovations that a line and their noise are taken from."""

_OF_THIRD_DIFFERENCES = 20.0
"""Variance of third differences of white noise over its own: 1 + 9 + 9 + 1."""

_BLOCK_PER_CORNER, _BLOCK = 2.0, 16
"""Length of a block over the reciprocal of the fastest corner, and in samples where no observer has
one."""

_LONGEST = 16
"""Blocks after which one is given up in which a channel has too few innovations."""

Innovations = tuple[Sequence[Innovation | None], ...]
"""Of each tick of a block those of all channels."""


class SensorError(NamedTuple):
    """What the blocks have shown of the error of a sensor, in squares of its unit.

    Attributes:
        square: Mean square of what the lines show.
        white: Share of the noise in it.
        peak: Fading peak of that square.
    """

    square: float = 0.0
    white: float = 0.0
    peak: float = 0.0


class MotionErrors(Struct, frozen=True, gc=False):
    """What the blocks have shown so far.

    Attributes:
        begin_ns: Time at which the present block began.
        end_ns: Time at which it is over.
        blocks: Number of blocks so far.
        noise_m2: Variance of the noise of each channel (heights, then motions).
        sensors: Of each sensor.
        stds: Standard deviation of each sensor; NaN before the first block, and where the heights
            do not determine the sensor.
    """

    begin_ns: int
    end_ns: int
    blocks: int
    noise_m2: list[float]
    sensors: list[SensorError]
    stds: list[float]


class SensorGains(NamedTuple):
    """How a sensor errs.

    Attributes:
        shown: Error by that of each channel.
        squares: Their squares.
        by_noise: Variance by that of the noise of each height that the model follows.
        by_motions: Variance by that of each motion over a block.
        directly: The same by what is faster, which moves the moved body alone.
    """

    shown: list[float]
    squares: list[float]
    by_noise: list[float]
    by_motions: list[float]
    directly: list[float]


class _Line(NamedTuple):
    """A straight line through the innovations of a channel in a block.

    Attributes:
        number: Number of innovations.
        spread_s2: Sum of squares of their times about the mean.
        noise_m2: Variance of their noise.
    """

    number: int
    spread_s2: float
    mean_m: float
    slope_m_per_s: float
    noise_m2: float


_TOO_FEW = _Line(0, 1.0, 0.0, 0.0, 0.0)


class TrackedErrors(Struct, frozen=True, gc=False):
    """State of the errors of sensors of motions.

    Attributes:
        errors: What the blocks have shown.
        gains: How each sensor errs, where the last block ended.
        pending: Innovations of the present block.
    """

    errors: MotionErrors
    gains: Sequence[SensorGains]
    pending: Innovations


class InnovationBlock(NamedTuple):
    """Length of a block.

    Attributes:
        shown: Share of a swing at the observers' fastest corner that a line over it shows, of the
            position and of the rate.
    """

    length_ns: int
    shown: tuple[float, float] = (1.0, 1.0)


def block_for(corners_per_s: Sequence[float], intervals_ns: Sequence[int]) -> InnovationBlock:
    """InnovationBlock for observers with some corners, and channels at some intervals."""
    longest_ns = max(intervals_ns)
    if not corners_per_s:
        return InnovationBlock(_BLOCK * longest_ns)
    corner_per_s = max(corners_per_s)
    length_ns = max(round(_BLOCK_PER_CORNER * 1e9 / corner_per_s), (_FEWEST + 1) * longest_ns)
    half = min(0.5e-9 * length_ns * corner_per_s, 0.5 * math.pi)
    rate = 3.0 * (math.sin(half) - half * math.cos(half)) / half**3
    return InnovationBlock(length_ns, (math.sin(half) / half, rate))


class MotionErrorTracker:
    """Tracks the errors of virtual sensors of motions.

    Args:
        reader: Reads the sensors of a model.
        sensors: Places of those of motions among them.
        struts: Indices of the struts whose heights are compared.
        channels: Places of their innovations and of those of motions among all innovations.
        is_rate: Of each sensor whether it reads a velocity, shape (k,).
        block: Length of a block, and what a line over it shows.
        by_noise: Motion of the struts by the noise of their heights, as of
            `rig.closed_loop.noise_response`.
    """

    def __init__(
        self,
        reader: AnySensorReader,
        sensors: Sequence[int],
        struts: Sequence[int],
        channels: Sequence[int],
        is_rate: Sequence[bool],
        block: InnovationBlock,
        by_noise: Array,
    ) -> None:
        self._reader, self._sensors = reader, list(sensors)
        self._struts = tuple(struts)
        self._channels = tuple(channels)
        self._orders = [int(of_rate) for of_rate in is_rate]
        self._block_ns = block.length_ns
        self._shown = [block.shown[order] ** 2 for order in self._orders]
        self._by_noise = by_noise

    def init(self, t_ns: int, loaded: Any) -> TrackedErrors:
        """State at the start of a model."""
        count = len(self._orders)
        errors = MotionErrors(
            t_ns,
            t_ns + self._block_ns,
            0,
            [0.0] * len(self._channels),
            [SensorError()] * count,
            [math.nan] * count,
        )
        return TrackedErrors(errors, self._find_gains(loaded), ())

    def update(
        self, tracked: TrackedErrors, t_ns: int, estimator: AnyEstimator, state: Any
    ) -> TrackedErrors:
        """State after a tick behind which an estimator has a state."""
        errors, gains = tracked.errors, tracked.gains
        pending = (*tracked.pending, estimator.innovations(state))
        if t_ns < errors.end_ns:
            return TrackedErrors(errors, gains, pending)
        errors = self._conclude(errors, pending, t_ns, gains, estimator.motion_errors(state))
        if not self._reader.has_constant_gains:
            gains = self._find_gains(estimator.model_of(state))
        return TrackedErrors(errors, gains, () if errors.begin_ns == t_ns else pending)

    def _find_gains(self, loaded: Any) -> list[SensorGains]:
        """How each sensor errs where the model is."""
        every = self._reader.motion_gains(loaded, self._struts)
        found: list[SensorGains] = []
        for sensor, order in zip(self._sensors, self._orders, strict=True):
            by_heights, by_motions, directly = (of_all[sensor] for of_all in every)
            shown = np.concatenate([by_heights, by_motions])
            by_noise = [
                _variance(by_heights, of_channel) for of_channel in self._by_noise[:, order]
            ]
            squares = (part.tolist() for part in (by_motions**2, directly**2))
            found.append(SensorGains(shown.tolist(), (shown**2).tolist(), by_noise, *squares))
        return found

    def _conclude(
        self,
        errors: MotionErrors,
        innovations: Innovations,
        t_ns: int,
        gains: Sequence[SensorGains],
        motions: Sequence[FollowedError],
    ) -> MotionErrors:
        """State at the end of a block with some innovations, and its standard deviations.

        The block begins where it did if a channel has too few of them.
        """
        lines = [_line(channel, innovations, errors.begin_ns) for channel in self._channels]
        if min([line.number for line in lines]) < _FEWEST:
            return self._prolong(errors, innovations, t_ns)
        blocks = errors.blocks + 1
        # The first blocks are those of the start, and fade as fast as others come.
        share = max(1.0 / _AVERAGED, 2.0 / (blocks + 1.0))
        noise_m2 = [
            known + share * (line.noise_m2 - known)
            for known, line in zip(errors.noise_m2, lines, strict=True)
        ]
        # Of positions and of rates.
        values = [line.mean_m for line in lines], [line.slope_m_per_s for line in lines]
        pairs = list(zip(noise_m2, lines, strict=True))
        whites = [m2 / of.number for m2, of in pairs], [m2 / of.spread_s2 for m2, of in pairs]
        block_s = 1e-9 * (t_ns - errors.begin_ns)
        of_motions = [_by_motion(motion, block_s) for motion in motions]
        heights_m2 = noise_m2[: len(self._struts)]
        sensors: list[SensorError] = []
        stds: list[float] = []
        every = zip(errors.sensors, gains, self._orders, self._shown, strict=True)
        # A dozen numbers: arrays of them would take ten times as long.
        for before, gain, order, shown in every:
            new = sum(map(mul, gain.shown, values[order])) ** 2
            of_noise = sum(map(mul, gain.squares, whites[order]))
            square = before.square + share * (new - before.square)
            white = before.white + share * (of_noise - before.white)
            peak = max(new, (1.0 - share) * before.peak)
            beyond = max(square - white, peak - _LARGEST_OF_NORMAL * square)
            variance = max(beyond, 0.0) / shown + sum(map(mul, gain.by_noise, heights_m2))
            of_gains = zip(of_motions, gain.by_motions, gain.directly, strict=True)
            for (slow, fast), by_motion, directly in of_gains:
                variance += by_motion * slow[order] + directly * fast[order]
            sensors.append(SensorError(square, white, peak))
            # A covariance of zero may be rounded to less.
            stds.append(math.sqrt(max(variance, 0.0)))
        return MotionErrors(t_ns, t_ns + self._block_ns, blocks, noise_m2, sensors, stds)

    def _prolong(self, errors: MotionErrors, innovations: Innovations, t_ns: int) -> MotionErrors:
        """State whose block is prolonged, or starts again where it has lasted for too long.

        Nothing is known any more where a channel has been silent for the length of a block.
        """
        passed_ns = t_ns - errors.begin_ns
        begin_ns = t_ns if passed_ns > _LONGEST * self._block_ns else errors.begin_ns
        silent = max([_silent_ticks(channel, innovations) for channel in self._channels])
        is_unknown = silent * passed_ns >= self._block_ns * len(innovations)
        stds = [math.nan] * len(errors.stds) if is_unknown else errors.stds
        return replace(errors, begin_ns=begin_ns, end_ns=t_ns + self._block_ns, stds=stds)


def _line(channel: int, innovations: Innovations, begin_ns: int) -> _Line:
    """The line through a channel's innovations in a block."""
    found = {new.t_ns: new.value for each in innovations if each and (new := each[channel])}
    n = len(found)
    if n < _FEWEST:
        return _TOO_FEW
    at = [1e-9 * (t_ns - begin_ns) for t_ns in found]
    values = list(found.values())
    mean_s, mean = sum(at) / n, sum(values) / n
    spread = sum([t * t for t in at]) - n * mean_s * mean_s
    slope = (sum(map(mul, at, values)) - n * mean_s * mean) / spread
    differences = zip(values, values[1:], values[2:], values[3:], strict=False)
    squares = sum([(d - a + 3.0 * (b - c)) ** 2 for a, b, c, d in differences])
    return _Line(n, spread, mean, slope, squares / (n - 3) / _OF_THIRD_DIFFERENCES)


def _by_motion(motion: FollowedError, block_s: float) -> tuple[list[float], list[float]]:
    """Variances of a motion that no innovation shows: of position and rate, slow and fast.

    All that hangs on a moved body follows the noise as far as it lasts for a block, as that of a
    parabola through the samples does; what is faster, and the lag, moves the moved body alone.
    """
    # Variances of position, rate and acceleration by a block's samples, and after the delay.
    density, h = motion.sample_m2 * motion.interval_s / block_s, motion.delay_s
    x, v, a = density, 12.0 * density / block_s**2, 720.0 * density / block_s**4
    line = np.array([x + h * h * v + 0.25 * h**4 * a, v + h * h * a])
    slow = np.minimum(motion.noise, line)
    return slow.tolist(), (motion.noise - slow + motion.lag).tolist()


def _silent_ticks(channel: int, innovations: Innovations) -> int:
    """Ticks since the newest innovation of a channel came."""
    times_ns = [new.t_ns if each and (new := each[channel]) else None for each in innovations]
    known_ns = [t_ns for t_ns in times_ns if t_ns is not None]
    return len(times_ns) - 1 - times_ns.index(max(known_ns)) if known_ns else len(times_ns)


def _variance(row: Array, covariance: Array) -> float:
    """Variance of a sum; what it does not contain need not be known."""
    used = np.flatnonzero(row)
    return float(row[used] @ covariance[np.ix_(used, used)] @ row[used])
