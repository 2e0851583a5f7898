"""The figures of a block, each a functional of its two mean strokes, and those of a rest.

Signs are those of the project: a force is positive when the strut pushes, so that damping is
positive in compression and negative in rebound. What a figure is:

    force at peak velocity    the mean stroke where the speed is largest
    window                    its mean over the tenth of the stroke to either side of the middle
    zero crossing             its value at mid-stroke
    peak                      its largest magnitude against the motion
    peak of the cycles        the largest mean over all strokes by phase, of samples as measured
    energy per cycle          what the loop of force over height encloses
    equivalent damping        the linear damping that takes the same energy from the same motion
    spring rate               fall of the mean of both strokes per height: gas, springs, and what of
                              a lag looks like one
    hysteresis at zero speed  compression less rebound stroke at the turning points: what friction
                              jumps by there, nothing where it builds up over a travel
                              (presliding); by speed: speeding up less slowing down, without the
                              spring

Reference: Dixon, The Shock Absorber Handbook (2007), 10; Lion and Loose, A thermomechanically
coupled model for automotive shock absorbers, Vehicle System Dynamics 37 (2002).
"""

from collections.abc import Mapping
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from rig.dyno.stroke_force import (
    ANGLES,
    Figure,
    ForceRange,
    MeanStroke,
    combine,
    mean_stroke,
)
from rig.dyno.strokes import Array, Block, BlockMotion, fit_motion, is_repetition

_QUASI_STATIC_M_PER_S = 5e-3
"""Peak speed up to which a step gives friction and gas force: seals and bleed alone damp there."""

_WINDOW = 0.1
"""Of half the stroke, to either side of the middle."""

_CENTRAL = 0.2
"""Share of half the stroke in which strokes are compared with each other: the speed is within two
per cent of its peak there."""

_SPEEDS = (0.25, 0.5, 0.75)
"""Shares of the peak speed at which hysteresis is reported."""

_RULE: tuple[Array, Array] = np.polynomial.legendre.leggauss(400)
_ANGLE_NODES, _WEIGHT = 0.5 * np.pi * _RULE[0], 0.5 * np.pi * _RULE[1]
"""Angles and weights of an integral over a stroke."""

_INNER = 0.9
"""Share of the stroke over which the spring rate is taken: at its ends friction reverses."""

_MOST_A_CYCLE = 1600
"""Samples of a cycle beyond which means of several are taken: within a quarter of a degree a force
is straight, and the means have what the samples said."""

_BATCHES = 10
"""Parts of a rest whose means give the uncertainty of its mean: noise may be correlated within one
(Law, Simulation Modeling and Analysis, 2015, 9.5.3)."""

SIDES = ("compression", "rebound")

LOAD_CELL = "load cell"
"""Source of a force whose lag is one time: that of an observer depends on the frequency."""


class ForceRecord(NamedTuple):
    """Measured motion and force of a strut.

    Attributes:
        t_s: Times, increasing, shape (N,).
        height_m: Heights, shape (N,).
        force_n: Strut forces, shape (N,), positive when the strut pushes.
        temperature_c: Temperatures, shape (N,), or None.
        strut: Name of the strut; empty where there is one.
    """

    name: str
    t_s: Array
    height_m: Array
    force_n: Array
    temperature_c: Array | None = None
    strut: str = ""
    source: str = LOAD_CELL

    def without(self, samples: NDArray[np.bool_]) -> "ForceRecord":
        """The record without some samples, shape (N,)."""
        kept = ~samples
        warm_c = None if self.temperature_c is None else self.temperature_c[kept]
        return self._replace(
            t_s=self.t_s[kept],
            height_m=self.height_m[kept],
            force_n=self.force_n[kept],
            temperature_c=warm_c,
        )


class Side(NamedTuple):
    """Figures of one direction, as the module describes them.

    Attributes:
        peak_velocity_m_per_s: Largest speed, positive.
        hysteresis_n: By share of the peak speed: force speeding up less force slowing down.
    """

    peak_velocity_m_per_s: Figure
    force_at_peak_velocity_n: Figure
    force_window_n: Figure
    force_zero_crossing_n: Figure
    peak_force_n: Figure
    peak_of_cycles_n: Figure
    hysteresis_n: Mapping[str, Figure]


class AtRest(NamedTuple):
    """Means over a hold: the gas force, and what friction keeps."""

    begin_s: float
    end_s: float
    height_m: float
    force_n: Figure
    temperature_c: float | None


class StrokeWarmth(NamedTuple):
    """Of each stroke of one direction its temperature, force about mid-stroke, and time."""

    temperature_c: Array
    force_n: Array
    t_s: Array


class DynoStep(NamedTuple):
    """Figures of a block, one step of a test, as the module describes them.

    Attributes:
        kind: `warm_up`, `quasi_static` or `velocity_step`.
        cycles: Cycles that were used.
        frequency_hz: Cycles a second; None where the motion is not periodic.
        amplitude_m: Half the stroke.
        middle_m: Height at mid-stroke.
        temperature_c: Mean temperature; None where none was measured.
        mean_force_n: Mean of both strokes at mid-stroke: the gas force where it is slow.
        half_difference_n: Half of compression less rebound at mid-stroke: the friction where it is
            slow.
        strokes: The mean strokes, compression and rebound.
        warmth: Each stroke, compression and rebound; none where no temperature was measured.
        velocity_std_m_per_s: Standard deviation of the peak velocities.
    """

    kind: str
    begin_s: float
    end_s: float
    cycles: float
    frequency_hz: float | None
    amplitude_m: float
    middle_m: float
    temperature_c: float | None
    compression: Side
    rebound: Side
    energy_per_cycle_j: Figure
    equivalent_damping_n_s_per_m: Figure
    spring_rate_n_per_m: Figure
    mean_force_n: Figure
    half_difference_n: Figure
    hysteresis_at_zero_n: Figure
    strokes: tuple[MeanStroke, MeanStroke]
    warmth: tuple[StrokeWarmth, StrokeWarmth]
    velocity_std_m_per_s: float

    def figures(self) -> dict[str, object]:
        """All but the arrays, by name."""
        inner = ("strokes", "warmth", "velocity_std_m_per_s")
        return {key: value for key, value in self._asdict().items() if key not in inner}

    def with_forces(
        self, strokes: tuple[MeanStroke, MeanStroke], warmth: tuple[StrokeWarmth, StrokeWarmth]
    ) -> "DynoStep":
        """The same motion with other forces, compression and rebound."""
        down, up = strokes
        std = self.velocity_std_m_per_s
        return self._replace(
            compression=_side(down, down, up, std),
            rebound=_side(up, down, up, std),
            **_of_both(down, up, std),
            strokes=strokes,
            warmth=warmth,
        )

    @property
    def peak_speed_m_per_s(self) -> float:
        """Larger of both sides' peak velocities."""
        return max(
            self.compression.peak_velocity_m_per_s.value, self.rebound.peak_velocity_m_per_s.value
        )


def find_motion(record: ForceRecord, block: Block) -> BlockMotion | None:
    """The motion that a block repeats; None if it repeats none."""
    times_s, heights_m = _thin(record.t_s, block), _thin(record.height_m, block)
    motion = fit_motion(times_s, heights_m, round(2.0 * block.cycles))
    if motion is None or not np.isnan(motion.period_s):
        return motion
    return motion if is_repetition(record.t_s, record.height_m, block) else None


def compute_step(
    record: ForceRecord,
    block: Block,
    motion: BlockMotion | None,
    limits: ForceRange,
    moving_mass_kg: float = 0.0,
) -> DynoStep | str:
    """Figures of a block and its motion, or why it has none.

    The load cell is clipped at the limits. Between it and the strut moves a mass.
    """
    t_s, warm_c = record.t_s, record.temperature_c
    force_n = _thin(record.force_n, block)
    warm_c = None if warm_c is None else _thin(warm_c, block)
    if motion is None:
        return f"{len(block.strokes)} strokes of one amplitude that do not repeat one motion"
    velocity, times_s = motion.velocity_m_per_s, _thin(t_s, block)
    # The strut accelerates the mass, whichever end it is at, and the cell holds what is left.
    force_n = force_n + moving_mass_kg * np.gradient(velocity, times_s)
    # A stroke ends where the velocity turns, which the samples hardly ever hit.
    turned = np.concatenate([[0], np.cumsum(np.diff(np.sign(velocity)) != 0)])
    down, up = (mean_stroke(motion, force_n, turned, sign) for sign in (-1, 1))
    if down is None or up is None:
        samples = (block.end - block.begin) / block.cycles
        return f"{len(block.strokes)} strokes with {samples:.0f} samples a cycle, which are too few"
    strokes = down.clipped_at(limits), up.clipped_at(limits)
    speed_std = motion.velocity_std_m_per_s
    down, up = strokes
    sides = _side(down, down, up, speed_std), _side(up, down, up, speed_std)
    speed = max(side.peak_velocity_m_per_s.value for side in sides)
    return DynoStep(
        kind="quasi_static" if speed <= _QUASI_STATIC_M_PER_S else "velocity_step",
        begin_s=float(t_s[block.begin]),
        end_s=float(t_s[block.end - 1]),
        cycles=block.cycles,
        frequency_hz=None if np.isnan(motion.period_s) else 1.0 / motion.period_s,
        amplitude_m=0.5 * (down.amplitude_m + up.amplitude_m),
        middle_m=0.5 * (down.middle_m + up.middle_m),
        temperature_c=None if warm_c is None else float(np.mean(warm_c)),
        compression=sides[0],
        rebound=sides[1],
        **_of_both(down, up, speed_std),
        strokes=strokes,
        warmth=(
            _warmth(down, motion, force_n, turned, warm_c, times_s),
            _warmth(up, motion, force_n, turned, warm_c, times_s),
        ),
        velocity_std_m_per_s=speed_std,
    )


def _thin(values: Array, block: Block) -> Array:
    """A channel (N,) of a record in a block, as means of some samples in a row if it has many."""
    share = max(1, int((block.end - block.begin) / block.cycles / _MOST_A_CYCLE))
    kept = (block.end - block.begin) // share * share
    inside = values[block.begin : block.begin + kept]
    return np.asarray(inside.reshape(-1, share).mean(axis=1), np.float64)


def compute_rest(record: ForceRecord, here: slice) -> AtRest:
    """Mean height, force and temperature of the samples `here`, at which the strut rests."""
    # A lag of the cell, and oil that relaxes, last into the rest; one of the height ends it early.
    edge = (here.stop - here.start) // _BATCHES
    settled = slice(here.start + edge, here.stop - edge)
    values, warm_c = record.force_n[settled], record.temperature_c
    means = np.array([part.mean() for part in np.array_split(values, min(_BATCHES, len(values)))])
    std = float(np.std(means, ddof=1)) / len(means) ** 0.5 if len(means) > 1 else float("nan")
    mean, half = float(values.mean()), 2.26 * std  # Student's t of ten batches
    return AtRest(
        float(record.t_s[here][0]),
        float(record.t_s[here][-1]),
        float(record.height_m[here].mean()),
        Figure.around(mean, half, "mean at rest, ten batches"),
        None if warm_c is None else float(warm_c[here].mean()),
    )


def _warmth(
    stroke: MeanStroke,
    motion: BlockMotion,
    force_n: Array,
    number: NDArray[np.int64],
    warm_c: Array | None,
    t_s: Array,
) -> StrokeWarmth:
    """Strokes of one direction; the force is the mean stroke's and what is more in each."""
    position = stroke.sign * (motion.height_m - stroke.middle_m) / stroke.amplitude_m
    central = (np.abs(position) < _CENTRAL) & (stroke.sign * motion.velocity_m_per_s > 0.0)
    is_clipped = np.any(stroke.beyond[np.abs(np.sin(ANGLES)) < _CENTRAL])
    if warm_c is None or is_clipped or not central.any():
        return StrokeWarmth(np.empty(0), np.empty(0), np.empty(0))
    more_n = force_n[central] - stroke.row(np.arcsin(position[central])) @ stroke.force_n
    about = np.arcsin(np.linspace(-_CENTRAL, _CENTRAL, 41))
    middle_n = float(np.mean(stroke.row(about) @ stroke.force_n))
    numbers = number[central]
    of_stroke = [numbers == n for n in np.unique(numbers)]
    return StrokeWarmth(
        np.array([warm_c[central][mine].mean() for mine in of_stroke]),
        np.array([middle_n + more_n[mine].mean() for mine in of_stroke]),
        np.array([t_s[central][mine].mean() for mine in of_stroke]),
    )


def _side(stroke: MeanStroke, down: MeanStroke, up: MeanStroke, speed_std: float) -> Side:
    speed, unit = np.abs(stroke.velocity_m_per_s), np.eye(len(ANGLES))
    peak = float(speed.max())
    row, what = unit[int(np.argmax(speed))], "mean stroke at the largest speed"
    method = "largest slope of the fitted motion"
    if stroke.is_constant:
        # Overshoot of the smoothed motion near its turning points is no larger speed.
        plateau = speed[np.abs(np.sin(ANGLES)) <= _WINDOW]
        peak, speed_std = float(plateau.mean()), float(np.hypot(speed_std, plateau.std()))
        row, what = stroke.row(0.0)[0], "mean stroke at mid-stroke: the speed is constant"
        method = "speed about mid-stroke, where it is constant"
    middle = np.arcsin(np.linspace(-_WINDOW, _WINDOW, 21))
    against = int(np.argmax(-stroke.sign * stroke.force_n))
    half = 1.96 * speed_std
    return Side(
        Figure.around(peak, half, method),
        stroke.figure(row, what),
        stroke.figure(
            stroke.row(middle).mean(axis=0), f"window of {100 * _WINDOW:.0f} % about mid-stroke"
        ),
        stroke.figure(stroke.row(0.0)[0], "zero crossing of the height"),
        stroke.figure(unit[against], "largest force of the mean stroke"),
        stroke.peak_of_cycles(),
        {f"{share:g}": _hysteresis(stroke, down, up, share * peak) for share in _SPEEDS},
    )


def _hysteresis(stroke: MeanStroke, down: MeanStroke, up: MeanStroke, speed: float) -> Figure:
    """Speeding up less slowing down at a speed, without the spring."""
    fast = np.flatnonzero(np.abs(stroke.velocity_m_per_s) >= speed)
    first, last = ANGLES[fast[0]], ANGLES[fast[-1]]
    own = (stroke.row(first) - stroke.row(last))[0]
    # The spring's share: its rate times the heights between, towards lower forces upwards.
    apart_m = stroke.sign * stroke.amplitude_m * float(np.sin(last) - np.sin(first))
    parts = [
        (own - apart_m * row if item is stroke else -apart_m * row, item)
        for row, item in _spring(down, up)
    ]
    return combine(parts, "same speed, speeding up less slowing down, spring removed")


def _spring(down: MeanStroke, up: MeanStroke) -> list[tuple[Array, MeanStroke]]:
    """The spring rate as rows: the least-squares slope of both strokes' mean, with its sign."""
    angles = float(np.arcsin(_INNER)) * _RULE[0]
    u, w = np.sin(angles), _RULE[1] * np.cos(angles)
    slope = w * u / float(np.sum(w * u * u))
    return [
        (-0.5 * item.sign / item.amplitude_m * (slope @ item.row(angles)), item)
        for item in (down, up)
    ]


class _OfBoth(TypedDict):
    """Figures of both directions together, by their names in a step."""

    energy_per_cycle_j: Figure
    equivalent_damping_n_s_per_m: Figure
    spring_rate_n_per_m: Figure
    mean_force_n: Figure
    half_difference_n: Figure
    hysteresis_at_zero_n: Figure


def _of_both(down: MeanStroke, up: MeanStroke, speed_std: float) -> _OfBoth:
    relative_std = speed_std / max(float(np.abs(it.velocity_m_per_s).max()) for it in (down, up))
    angles = _ANGLE_NODES
    along = _WEIGHT * np.cos(angles)
    work = [
        (-item.sign * item.amplitude_m * (along @ item.row(angles)), item) for item in (down, up)
    ]
    squared = sum(
        item.amplitude_m * float(along @ np.abs(item.row(angles) @ item.velocity_m_per_s))
        for item in (down, up)
    )
    mid_down, mid_up = down.row(0.0)[0], up.row(0.0)[0]
    # The upper turning point ends the rebound and begins the compression, the lower one the other.
    turning_down, turning_up = (
        (item.row(-0.5 * np.pi) + item.row(0.5 * np.pi))[0] for item in (down, up)
    )
    linear = "energy over that of a linear damper of 1 N·s/m"
    slope = "slope of the mean of both strokes, inner 90 %"
    difference = "half the difference of both at mid-stroke"
    turning = [(turning_down, down), (-turning_up, up)]
    return {
        "energy_per_cycle_j": combine(work, "area of the loop", 1.0, relative_std),
        "equivalent_damping_n_s_per_m": combine(work, linear, 1.0 / squared, relative_std),
        "spring_rate_n_per_m": combine(_spring(down, up), slope, 1.0, relative_std),
        "mean_force_n": combine(
            [(mid_down, down), (mid_up, up)], "mean of both strokes at mid-stroke", 0.5
        ),
        "half_difference_n": combine([(mid_down, down), (-mid_up, up)], difference, 0.5),
        "hysteresis_at_zero_n": combine(turning, "difference at the turning points", 0.5),
    }
