"""Delays and gains of a recording's channels against its reference, as parameters of a fit.

A channel that is late shows at a time what was true the delay before. The reference of a driven
bench is its first input, that of a prescribed motion the height of the load cell's own strut: a
delay of all channels together cannot be seen and changes nothing. What a model gives is read the
delay earlier; the measurements stay as they are, and so does their noise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array

from dart_model.spec import ModelSpec
from rig.channels.measured_quantities import HEIGHT, LOAD_CELL_FORCE
from rig.diagnosis.numerics.hermite import read_late
from rig.diagnosis.problem.problem import LinearParameter
from rig.recordings.recording import Recording
from rig.recordings.recording_checks import inputs_of

Array = NDArray[np.float64]

STD_S = 2e-3
"""Standard deviation of the prior on a delay: the filter of a load cell's amplifier (a second-order
one of 100 Hz delays by 2.3 ms), or two cycles of a bus at 1 kHz. Where the data determine a delay,
a tenth of it or ten times as much are found alike."""
LONGEST_S = 0.1
"""Longest delay, either way, that is searched for."""
SIGNIFICANT = 4.0
"""Standard deviations from which on an estimate counts before a search, or without one."""
GAIN_STD, MOST_GAIN = 0.02, 0.2
"""Standard deviation of the prior on a height's gain, and its largest change: displacement sensors
are calibrated to a percent or better, and wired with a wrong range now and then."""
_HELD_S = 1e-6
"""Largest change of a delay that the data do not show. It has the effect of corrections of
stiffness and damping, beside which a fit would choose whatever makes up for a law's wrong shape at
one frequency, and is wrong at any other; so it is what the recording states. Intervals contain the
deviation of its prior all the same, for which its range must have room for a difference."""
_UNKNOWN_S = 0.01
"""Longest such delay that is considered in place of corrections of stiffness and damping."""


class Delays(NamedTuple):
    """Delays in s.

    Attributes:
        struts: Of each strut's height or load cell, shape (struts,).
        inputs: Of each input of the model, shape (inputs,).
    """

    struts: Array
    inputs: Array


def delay_parameters(spec: ModelSpec, recording: Recording) -> tuple[LinearParameter, ...]:
    """The delays that a recording may have, as parameters of the linear part.

    A strut whose model has a `delay` of its own has that instead.
    """
    cells_n, delays = recording.strut_forces_n, list[LinearParameter]()
    column = HEIGHT.column if recording.inputs else LOAD_CELL_FORCE.column
    for index, strut in enumerate(spec.struts):
        is_seen = recording.inputs or (cells_n is not None and np.isfinite(cells_n[:, index]).all())
        if is_seen and not any(item.name == "delay" for item in strut.effects):
            delays.append(_parameter(recording, index, -1, f"{column}:{strut.name}"))
    inputs = inputs_of(recording, spec) if recording.inputs else {}
    for index, (name, item) in enumerate(inputs.items()):
        if index:
            delays.append(_parameter(recording, 0, index, f"{item.quantity.column}:{name}"))
    return tuple(delays)


def height_gains(spec: ModelSpec) -> tuple[LinearParameter, ...]:
    """Gains of the heights of a bench whose base is moved as measured, against this motion.

    A gain of all channels together cannot be seen: it changes what is not linear in the struts.
    """
    return tuple(
        LinearParameter(
            index,
            "height_gain",
            1.0,
            GAIN_STD,
            -MOST_GAIN,
            channel=f"{HEIGHT.column}:{strut.name}",
            most=MOST_GAIN,
        )
        for index, strut in enumerate(spec.struts)
    )


def is_undetermined(parameter: LinearParameter) -> bool:
    """Whether it is a delay of which the data showed nothing before the search."""
    ends = (-parameter.least, parameter.most)
    return parameter.kind == "delay" and ends in ((_HELD_S,) * 2, (_UNKNOWN_S,) * 2)


def search_undetermined(linear: Sequence[LinearParameter]) -> tuple[LinearParameter, ...]:
    """Linear parameters of which delays are searched for that the data did not show."""
    return tuple(
        p._replace(least=-_UNKNOWN_S, most=_UNKNOWN_S) if is_undetermined(p) else p for p in linear
    )


def _parameter(recording: Recording, strut: int, index: int, channel: str) -> LinearParameter:
    known_s = recording.delays_s.get(channel, 0.0)
    return LinearParameter(strut, "delay", known_s, STD_S, -_HELD_S, index, channel, _HELD_S)


def delays_of(
    parameters: Sequence[LinearParameter], changes: Array, struts: int, inputs: int
) -> Delays:
    """The delays among linear parameters with their changes, shape (L,)."""
    delays = Delays(np.zeros(struts), np.zeros(inputs))
    for parameter, change in zip(parameters, changes, strict=True):
        if parameter.kind == "delay":
            if parameter.input < 0:
                delays.struts[parameter.strut] = change
            else:
                delays.inputs[parameter.input] = change
    return delays


def gains_of(parameters: Sequence[LinearParameter], changes: Array, struts: int) -> Array:
    """Gain of each strut's height by linear parameters with their changes, shape (struts,)."""
    gains = np.ones(struts)
    for parameter, change in zip(parameters, changes, strict=True):
        if parameter.kind == "height_gain":
            gains[parameter.strut] += change
    return gains


def late_columns(t_s: Array, values: Array, rates: Array | None, delays_s: Array) -> Array:
    """Columns (N, k, ...) as they are seen with a delay (s) each, shape (k,).

    Between times they are cubic, through their rates of change (N, k, ...) where these are given;
    before and after them they go on at these rates, else they stay. (A motion that stops dead at
    its end has a bend there, which no smoothing takes for noise.)
    """
    late = values
    for column, delay_s in enumerate(delays_s.tolist()):
        if delay_s == 0.0:
            continue
        if late is values:
            late = values.copy()
        if rates is None:
            known_s = np.clip(t_s - delay_s, t_s[0], t_s[-1])
            late[:, column] = CubicSpline(t_s, values[:, column])(known_s)
        else:
            late[:, column] = read_late(t_s, values[:, column], rates[:, column], delay_s)
    return late


def known_share(t_s: Array, delays_s: Array) -> Array:
    """Weights (N, k) of rows: zero where a delay asks for what was before or after a recording.

    Over the last sample they go to zero linearly, so that they have a derivative by the delay.
    """
    step = (t_s[-1] - t_s[0]) / (len(t_s) - 1)
    there = t_s[:, np.newaxis] - delays_s
    return np.clip(1.0 + np.minimum(there - t_s[0], t_s[-1] - there) / step, 0.0, 1.0)


def late_reader(grid_s: Array, at_s: Array, delays_s: Array) -> csr_array:
    """Matrix that reads columns on a grid as delayed sensors show them at some times.

    Args:
        grid_s: Times of the grid, shape (N,).
        at_s: Times that are read, among them, shape (m,).
        delays_s: Delay of each column, shape (k,).

    Returns:
        Weights, shape (m k, N k), of columns (N, k) in what is read, (m, k), both by rows.
    """
    late_s = np.clip(at_s[:, np.newaxis] - delays_s, grid_s[0], grid_s[-1])
    first = np.clip(np.searchsorted(grid_s, late_s) - 2, 0, len(grid_s) - _POINTS)
    around = first[..., np.newaxis] + np.arange(_POINTS)
    weights = _lagrange_weights(grid_s[around], late_s)
    exact = np.searchsorted(grid_s, at_s - 1e-12)[:, np.newaxis, np.newaxis]
    weights = np.where(delays_s[:, np.newaxis] == 0.0, around == exact, weights)
    count = len(delays_s)
    columns = around * count + np.arange(count)[:, np.newaxis]
    ends = np.arange(0, weights.size + 1, _POINTS)
    shape = len(at_s) * count, len(grid_s) * count
    reader = csr_array((weights.ravel(), columns.ravel(), ends), shape=shape)
    reader.eliminate_zeros()
    return reader


_POINTS = 4
"""Points of a cubic."""


def _lagrange_weights(nodes: Array, at: Array) -> Array:
    """Weights (..., k) of values at nodes (..., k) in their polynomial's value at times (...)."""
    weights = np.ones_like(nodes)
    for i in range(nodes.shape[-1]):
        for j in range(nodes.shape[-1]):
            if i != j:
                weights[..., i] *= (at - nodes[..., j]) / (nodes[..., i] - nodes[..., j])
    return weights
