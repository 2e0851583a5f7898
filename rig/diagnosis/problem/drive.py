"""What drove a recording, as the input vector of the model over time, and the noise in it.

A force or torque is a cubic spline between its samples. The motion of a body is smoothed, so that
its velocity and acceleration are those of a body and not of the sensor's noise. Where the
acceleration was measured, only the difference of the positions from its double integral is
smoothed: that has what the accelerometer does not show, its zero and slow motion.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline, make_lsq_spline

from dart_model.plant.motion_between import coefficients, evaluate
from dart_model.spec import ModelSpec, MotionInput
from rig.channels.measured_quantities import APPLIED_FORCE, MOTION
from rig.diagnosis.numerics.smoother import Noise, estimate_noise, smooth
from rig.diagnosis.problem.grid import fine_times
from rig.recordings.recording import RecordedInput, Recording
from rig.recordings.recording_checks import inputs_of

Array = NDArray[np.float64]

_LARGEST_NOISE = 0.01
"""Share of an input's range from which on its rough part is excitation, not noise."""
_TOP = 0.8
"""Share of the sampled band above which a bench excites nothing: anti-aliasing filters and the
actuator end below, so that only noise is left above."""


class InputOverTime(NamedTuple):
    """An input at measured times.

    Attributes:
        t_s: Times, shape (N,).
        states: Force (N) or torque (N·m) at them, shape (N, 1); of a motion position and its first
            three derivatives, shape (N, 4).
        noise: Noise of the positions of a motion; None of a force or torque.
    """

    t_s: Array
    states: Array
    noise: Noise | None = None

    @property
    def size(self) -> int:
        """Its length in the input vector."""
        return 1 if self.noise is None else 3

    def at(self, t_s: Array) -> Array:
        """Its part of the input vector at some times, shape (len(t_s), 1 or 3)."""
        if self.noise is None:
            return np.asarray(CubicSpline(self.t_s, self.states)(t_s), dtype=np.float64)
        return _between(self.t_s, self.states, t_s)

    def smoothed(self, nodes_s: Array, t_s: Array) -> "InputOverTime":
        """The input as a cubic spline between some of all nodes; a motion is smooth as it is.

        That nearest to the values at all nodes keeps the impulse of a force; one through those at
        some nodes would keep their noise of all frequencies.
        """
        if self.noise is not None:
            return self
        # Knots as those of the cubic spline through its values, so that both are one.
        knots = np.concatenate([np.repeat(t_s[0], 4), t_s[2:-2], np.repeat(t_s[-1], 4)])
        spline = make_lsq_spline(nodes_s, self.at(nodes_s), knots, method="norm-eq")
        return InputOverTime(t_s, np.asarray(spline(t_s), dtype=np.float64))


class Drive(NamedTuple):
    """What drove a recording: the inputs of the model, in its order."""

    inputs: tuple[InputOverTime, ...]
    first_force: int | None

    def at(self, t_s: Array) -> Array:
        """Input vector at some times, shape (len(t_s), inputs)."""
        return np.hstack([item.at(t_s) for item in self.inputs])

    def before_delays(self, t_s: Array, delays_s: Array) -> Array:
        """Input vector at some times where each input was measured a delay too late.

        Beyond the recording it stays as it is at the end.
        """
        times = (np.clip(t_s + delay_s, t_s[0], t_s[-1]) for delay_s in delays_s.tolist())
        return np.hstack([item.at(own) for item, own in zip(self.inputs, times, strict=True)])

    def smoothed(self, nodes_s: Array, t_s: Array) -> "Drive":
        """The drive with forces that are cubic splines between some of all nodes."""
        return self._replace(inputs=tuple(item.smoothed(nodes_s, t_s) for item in self.inputs))

    @property
    def has_force(self) -> bool:
        """Whether a force or torque is among them, which gives forces and masses their scale."""
        return any(item.noise is None for item in self.inputs)

    @property
    def moved(self) -> list[int]:
        """Index of each motion's position in the input vector."""
        firsts = np.cumsum([0, *(item.size for item in self.inputs)]).tolist()
        return [
            first
            for first, item in zip(firsts, self.inputs, strict=False)
            if item.noise is not None
        ]

    def applied_n(self, vector: Array) -> Array:
        """Applied force of the laws that depend on one, shape (N,), by the input vector."""
        if self.first_force is None:
            return np.zeros(len(vector))
        return np.ascontiguousarray(vector[:, self.first_force])


def drive_of_recording(spec: ModelSpec, recording: Recording) -> Drive:
    """The drive of a recording; zero where its motion is prescribed.

    Raises:
        RecordingError: Its inputs are not the model's.
    """
    if recording.inputs:
        return _drive_of(recording.t_s, inputs_of(recording, spec))
    t_s, nothing = recording.t_s, np.zeros((len(recording.t_s), 4))
    inputs = tuple(
        InputOverTime(t_s, nothing, Noise(0.0, 1.0))
        if isinstance(item, MotionInput)
        else InputOverTime(t_s, nothing[:, :1])
        for item in spec.drive.values()
    )
    return Drive(inputs, None)


def _drive_of(t_s: Array, recorded: Mapping[str, RecordedInput]) -> Drive:
    inputs: list[InputOverTime] = []
    first_force: int | None = None
    size = 0
    for item in recorded.values():
        if item.quantity is MOTION:
            inputs.append(_smooth_motion(t_s, item))
        else:
            if item.quantity is APPLIED_FORCE and first_force is None:
                first_force = size
            inputs.append(InputOverTime(t_s, item.values[:, np.newaxis]))
        size += inputs[-1].size
    return Drive(tuple(inputs), first_force)


def _smooth_motion(t_s: Array, item: RecordedInput) -> InputOverTime:
    known = np.zeros((len(t_s), 4))
    if item.acceleration_m_per_s2 is not None:
        acceleration = item.acceleration_m_per_s2
        velocity = cumulative_trapezoid(acceleration, t_s, initial=0)
        position = cumulative_trapezoid(velocity, t_s, initial=0)
        slope = CubicSpline(t_s, acceleration)(t_s, 1)
        known = np.column_stack([position, velocity, acceleration, slope])
    difference = item.values - known[:, 0]
    middle = float(np.mean(difference))
    noise = estimate_noise(t_s, difference - middle)
    states = smooth(t_s, difference - middle, noise).states + known
    states[:, 0] += middle
    return InputOverTime(t_s, states, noise)


def _between(nodes_s: Array, states: Array, t_s: Array) -> Array:
    """Position, velocity and acceleration at some times, as a plant takes them, (len(t_s), 3)."""
    at = np.clip(np.searchsorted(nodes_s, t_s, side="right") - 1, 0, len(nodes_s) - 2)
    lengths = np.diff(nodes_s)
    begin, end = (list(states[nodes, :3].T) for nodes in (at, at + 1))
    course = coefficients(begin, end, lengths[at])
    share = (t_s - nodes_s[at]) / lengths[at]
    return np.column_stack(evaluate(course, share, lengths[at]))


def draw_noise(
    drive: Drive, stds: Sequence[float], nodes_s: Array, parts: int, rng: np.random.Generator
) -> Array:
    """A draw of the noise of the measured inputs, shape (parts * (N - 1) + 1, inputs).

    Of forces it is constant from node to node: the error of a force is held over a sample or so.
    Of a motion it is what the smoother makes of white noise in the positions.
    """
    columns: list[Array] = []
    for item, std in zip(drive.inputs, stds, strict=True):
        white = std * rng.standard_normal(len(nodes_s))
        if item.noise is None:
            columns.append(np.append(np.repeat(white[:-1], parts), white[-1])[:, np.newaxis])
        else:
            states = smooth(nodes_s, white, item.noise).states
            columns.append(_between(nodes_s, states, fine_times(nodes_s, parts)))
    return np.hstack(columns)


def noise_stds(drive: Drive, nodes_s: Array) -> tuple[float, ...]:
    """Standard deviation of each input's measured values, at some nodes."""
    return tuple(
        _force_noise(item, nodes_s) if item.noise is None else float(np.sqrt(item.noise.variance))
        for item in drive.inputs
    )


def _force_noise(item: InputOverTime, nodes_s: Array) -> float:
    """Standard deviation of an applied force's noise and resolution.

    White noise fills the whole band. What is not smooth, but not at the top of the band either, is
    excitation.
    """
    force = item.at(nodes_s)[:, 0]
    force = force - force.mean()
    variance = estimate_noise(nodes_s, force).variance
    window = np.hanning(len(force))
    power = np.abs(np.fft.rfft(force * window)) ** 2 / float(window @ window)
    # Lines of a periodogram are exponentially distributed: their median is ln 2 of their mean.
    top = float(np.median(power[int(_TOP * len(power)) :])) / np.log(2.0)
    return min(float(np.sqrt(min(variance, top))), _LARGEST_NOISE * float(np.ptp(force)))
