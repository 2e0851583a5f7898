"""The spring-damper forces of a finished run, smoothed over the whole of it.

An observer knows the past alone, and lags. A finished run has both sides of every instant. The
error that the model would have had without virtual forces is the innovation plus what these have
moved; its second derivative is the residual forces times the model's mobility,

    d²(z - z_free)/dt² = W d,    F = F_law + d,

and is smoothed as in a diagnosis, which also finds the sensor's noise and the deviation. That holds
exactly where W does not depend on where the bench is, and as far as the log has the virtual force
at all times: a tick that takes several heights changes it in between, so heights that are faster
than the ticks are refused, and a stretch ends where ticks were missed.

References:
    Rauch, Tung, Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA J. 3 (1965).
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from can_dbc.errors import InputError
from dart_model.protocol import AMBIENT_C
from rig.bridge.values import Mode
from rig.diagnosis.numerics.smoother import estimate_noise, smooth
from rig.log.reader import RunFolder, read_run
from rig.plan.build import build_plant
from rig.plan.load import plan_of_run
from rig.plan.plan import Plan
from rig.tuning.expectation import FEWEST, free_error, stretches

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_LONGEST_S, _OVERLAP_S = 60.0, 2.0
"""Of a piece: a force that the model lacks all the time moves its error by t², and digits with it;
and by how much two pieces overlap, each used up to the middle: filters settle in less."""

_MISSED = 1.5
"""Periods between two ticks from which on one was missed."""

_SINGULAR = 1e-9
"""Share of the largest mobility below which a combination of forces moves nothing."""


class _Strut(NamedTuple):
    """A strut's columns of a run, by tick.

    Attributes:
        virtual_n: Virtual force.
        law_n: Force of the model's law.
        innovation_m: Innovation.
        measured_s: Time of the measurement; NaN where none came.
    """

    virtual_n: Array
    law_n: Array
    innovation_m: Array
    measured_s: Array


def read_smoothed(folder: Path, progress: Progress) -> RunFolder:
    """A run whose steps also have `STRUT.smoothed_force_n` and `STRUT.smoothed_force_std_n`.

    Args:
        folder: The run's folder.
        progress: Called with what is being done and the share that is done.

    Raises:
        InputError: The run is damaged, or its forces cannot be smoothed.
    """
    found, plan = read_run(folder), plan_of_run(folder)
    steps = found.steps
    for name, (force_n, std_n) in smoothed_forces(found, plan, progress).items():
        for key, values in (("smoothed_force_n", force_n), ("smoothed_force_std_n", std_n)):
            steps = steps.append_column(f"{name}.{key}", cast("Any", pa).array(values))
    return replace(found, steps=steps)


def smoothed_forces(
    found: RunFolder, plan: Plan, progress: Progress
) -> dict[str, tuple[Array, Array]]:
    """Force of each strut at each tick, and its standard deviation, by the strut's name.

    Args:
        found: The run.
        plan: The configuration it ran with.
        progress: Called with what is being done and the share that is done.

    Returns:
        Two arrays in N of shape (ticks,); NaN where the bridge was not RUNNING, and of all struts
        where one of them had fewer than 200 heights in the stretch, or in a minute of it.

    Raises:
        InputError: The run's model has no constant mobility, not every strut is observed, heights
            come faster than ticks, or there is nothing to smooth.
    """
    names = plan.strut_names
    mobility = _mobility(found, plan, names)
    tick_s = found.steps.column("t_ns").to_numpy() * 1e-9
    struts = [_strut(found, name) for name in names]
    forces = {name: (np.full(len(tick_s), np.nan), np.full(len(tick_s), np.nan)) for name in names}
    running = found.steps.column("mode").to_numpy() == Mode.RUNNING
    missed_s = _MISSED * plan.period_ns * 1e-9
    unbroken = [
        part for stretch in stretches(running) for part in _unbroken(tick_s, stretch, missed_s)
    ]
    pieces = [piece for stretch in unbroken for piece in _pieces(tick_s, stretch)]
    for number, (piece, inner) in enumerate(pieces):
        progress("smoothing", number / len(pieces))
        residual = _residual(tick_s, piece, struts, mobility)
        if residual is None:
            continue
        used = slice(inner.start - piece.start, inner.stop - piece.start)
        for strut, (force, deviation), of in zip(struts, residual, forces.values(), strict=True):
            of[0][inner] = strut.law_n[inner] + force[used]
            of[1][inner] = deviation[used]
    if all(np.all(np.isnan(force)) for force, _ in forces.values()):
        raise InputError(
            f"{found.folder}: nowhere RUNNING with {FEWEST} heights of each strut within "
            f"{_LONGEST_S:g} s and no tick missed between them"
        )
    return forces


def _mobility(found: RunFolder, plan: Plan, names: list[str]) -> Array:
    """Second derivative of each height per newton in each strut, in 1/kg."""
    wanted = "smoothing wants a model whose masses move along straight guides"
    if plan.is_prescribed:
        raise InputError(f"{found.folder}: prescribed_motion: its load cell measures the force")
    if len(plan.struts) > len(plan.heights):
        raise InputError(f"{found.folder}: observers: kind none: smoothing wants every height")
    for strut in plan.struts:
        if strut.interval_ns * _MISSED < plan.period_ns:
            raise InputError(
                f"{found.folder}: height {strut.name}: every {strut.interval_ns} ns, ticks every "
                f"{plan.period_ns} ns: smoothing wants at most one height a tick"
            )
    plant = build_plant(plan)
    if not plant.is_constant:
        raise InputError(f"{found.folder}: model {plan.model.name}: {wanted}")
    rest = plant.numbers(plant.init([strut.free_length_m for strut in plan.struts]))
    state = plant.state_of([0.0] * len(rest))

    def accelerations(virtual_n: Array) -> Array:
        loaded = plant.load(state, tuple(virtual_n.tolist()), 0.0, AMBIENT_C)
        return np.array(loaded.accelerations_m_per_s2)

    without = accelerations(np.zeros(len(names)))
    mobility = np.column_stack([accelerations(one) - without for one in np.eye(len(names))])
    singular = np.linalg.svd(mobility, compute_uv=False)
    if singular[-1] < _SINGULAR * singular[0]:
        raise InputError(f"{found.folder}: model {plan.model.name}: more struts than coordinates")
    return mobility


def _strut(found: RunFolder, name: str) -> _Strut:
    if f"{name}.law_force_n" not in found.steps.schema.names:
        raise InputError(f"{found.folder}: has no steps of strut {name}, expected a run with some")

    def column(key: str) -> Array:
        return np.asarray(found.steps.column(f"{name}.{key}").to_numpy(), dtype=np.float64)

    return _Strut(
        column("virtual_force_n"),
        column("law_force_n"),
        column("innovation_m"),
        column("measured_t_ns") * 1e-9,
    )


def _unbroken(tick_s: Array, stretch: slice, missed_s: float) -> list[slice]:
    """The parts of a stretch between which ticks were missed."""
    breaks = np.flatnonzero(np.diff(tick_s[stretch]) > missed_s) + 1 + stretch.start
    edges = [stretch.start, *breaks.tolist(), stretch.stop]
    return [slice(begin, end) for begin, end in itertools.pairwise(edges)]


def _pieces(tick_s: Array, stretch: slice) -> list[tuple[slice, slice]]:
    """A stretch in pieces that overlap, each with the part that it is used for."""
    within_s = tick_s[stretch]
    first_s, last_s = float(within_s[0]), float(within_s[-1])

    def place(t_s: float) -> int:
        return stretch.start + int(np.searchsorted(within_s, t_s))

    count = max(1, math.ceil((last_s - first_s) / _LONGEST_S))
    length_s = (last_s - first_s) / count
    edges = [*(place(first_s + k * length_s) for k in range(count)), stretch.stop]
    found: list[tuple[slice, slice]] = []
    for begin, end in itertools.pairwise(edges):
        low_s, high_s = tick_s[begin] - 0.5 * _OVERLAP_S, tick_s[end - 1] + 0.5 * _OVERLAP_S
        found.append((slice(place(low_s), place(high_s)), slice(begin, end)))
    return found


def _residual(
    tick_s: Array, piece: slice, struts: list[_Strut], mobility: Array
) -> list[tuple[Array, Array]] | None:
    """Residual force of each strut at a piece's ticks and its deviation; None where it is short."""
    times_s = tick_s[piece]
    virtual_n = np.array([strut.virtual_n[piece] for strut in struts])
    means, variances = np.full((2, len(struts), len(times_s)), np.nan)
    for index, strut in enumerate(struts):
        measured_s = strut.measured_s[piece]
        fresh = np.isfinite(measured_s) & (measured_s >= times_s[0])
        t_s, first = np.unique(measured_s[fresh], return_index=True)
        if len(t_s) < FEWEST:
            return None
        innovation_m = strut.innovation_m[piece][fresh][first]
        free_m = free_error(times_s, -mobility[index] @ virtual_n, t_s, innovation_m)
        # At ticks without a height the smoother knows what lies between its neighbours.
        all_s = np.union1d(t_s, times_s)
        known_m = np.full(len(all_s), np.nan)
        known_m[np.searchsorted(all_s, t_s)] = free_m
        smoothed = smooth(all_s, known_m, estimate_noise(t_s, free_m))
        ticks = np.searchsorted(all_s, times_s)
        means[index] = smoothed.states[ticks, 2]
        variances[index] = smoothed.deviations[ticks, 2] ** 2
    forces = np.linalg.solve(mobility, means)
    deviations = np.sqrt(np.linalg.inv(mobility) ** 2 @ variances)
    return list(zip(forces, deviations, strict=True))
