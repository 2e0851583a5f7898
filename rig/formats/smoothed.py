"""The spring-damper forces of a finished run, smoothed over the whole run.

An observer uses the past alone, and lags; a finished run also has what follows each instant. The
error of the model without virtual forces is the innovation plus the displacement that the virtual
forces caused; its second derivative is the residual forces times the model's mobility W,

    d²(z - z_free)/dt² = W d,    F = F_law + d,

and is smoothed as in a diagnosis, which also estimates the sensor's noise and the standard
deviation. This is exact where W does not depend on the position of the bench and the log holds the
virtual force at all times: several heights in one tick change the force between log entries, so
heights that are faster than the ticks are refused, and a stretch ends where ticks were missed.

References:
    Rauch, Tung, Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA J. 3 (1965).
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.bridge.values import Mode
from rig.closed_loop.strut_response import linearise_at
from rig.diagnosis.numerics.smoother import estimate_noise, smooth
from rig.log.reader import RunFolder, read_run
from rig.plan.build import build_plant
from rig.plan.load import plan_of_header
from rig.plan.plan import Plan
from rig.recordings.stretches import find_stretches
from rig.tuning.expectation import FEWEST, free_error

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_LONGEST_S, _OVERLAP_S = 60.0, 2.0
"""Length of a piece: a constant missing force lets the error grow with t², which costs digits; and
overlap of two pieces, each used up to its middle: filters settle in less."""

_MISSED = 1.5
"""Periods between two ticks above which one was missed."""

_SINGULAR = 1e-9
"""Share of the largest mobility below which a combination of forces causes no motion."""


class _StrutColumns(NamedTuple):
    """Columns of a strut, shape (ticks,) each; NaN in `measured_s` where nothing was measured."""

    virtual_n: Array
    law_n: Array
    innovation_m: Array
    measured_s: Array


def read_with_smoothed_forces(folder: Path, progress: Progress) -> RunFolder:
    """A run whose steps also have `STRUT.smoothed_force_n` and `STRUT.smoothed_force_std_n`.

    Raises:
        InputError: The run is damaged, or its forces cannot be smoothed.
    """
    run = read_run(folder)
    plan = plan_of_header(folder, run.header)
    steps = run.steps
    for name, (force_n, std_n) in smooth_forces(run, plan, progress).items():
        for key, values in (("smoothed_force_n", force_n), ("smoothed_force_std_n", std_n)):
            steps = steps.append_column(f"{name}.{key}", pa.array(values))
    return replace(run, steps=steps)


def compare_published(run: RunFolder) -> dict[str, float]:
    """RMS difference of each strut's estimate from its smoothed force over the valid ticks, in N.

    The run is one with smoothed forces; NaN where no tick has both.
    """
    differences: dict[str, float] = {}
    for column in run.steps.schema.names:
        name = column.removesuffix(".smoothed_force_n")
        if name == column:
            continue
        force_n, smoothed_n, valid = (
            np.asarray(run.steps.column(f"{name}.{key}").to_numpy(), np.float64)
            for key in ("force_n", "smoothed_force_n", "valid")
        )
        apart_n = (force_n - smoothed_n)[valid == 1.0]
        apart_n = apart_n[np.isfinite(apart_n)]
        differences[name] = float(np.sqrt(np.mean(apart_n**2))) if len(apart_n) else math.nan
    return differences


def smooth_forces(run: RunFolder, plan: Plan, progress: Progress) -> dict[str, tuple[Array, Array]]:
    """Force of each strut at each tick, and its standard deviation, by the strut's name.

    `progress` is called with the name of the stage and the share that is done.

    Returns:
        Two arrays in N of shape (ticks,); NaN where the bridge was not RUNNING, and of all struts
        where one of them had fewer than 200 heights in the stretch, or in a minute of it.

    Raises:
        InputError: The run's model has no constant mobility, not every strut is observed, heights
            come faster than ticks, or there is nothing to smooth.
    """
    names = plan.strut_names
    mobility = _mobility(run, plan)
    tick_s = run.steps.column("t_ns").to_numpy() * 1e-9
    struts = [_strut_columns(run, name) for name in names]
    forces = {name: (np.full(len(tick_s), np.nan), np.full(len(tick_s), np.nan)) for name in names}
    running = run.steps.column("mode").to_numpy() == Mode.RUNNING
    missed_s = _MISSED * plan.period_ns * 1e-9
    unbroken = [
        part
        for stretch in find_stretches(running)
        for part in _split_at_gaps(tick_s, stretch, missed_s)
    ]
    pieces = [piece for stretch in unbroken for piece in _split_long(tick_s, stretch)]
    for number, (piece, inner) in enumerate(pieces):
        progress("smoothing", number / len(pieces))
        residual = _residual_forces(tick_s, piece, struts, mobility)
        if residual is None:
            continue
        used = slice(inner.start - piece.start, inner.stop - piece.start)
        for strut, (force, deviation), result in zip(
            struts, residual, forces.values(), strict=True
        ):
            result[0][inner] = strut.law_n[inner] + force[used]
            result[1][inner] = deviation[used]
    if all(np.all(np.isnan(force)) for force, _ in forces.values()):
        raise InputError(
            f"{run.folder}: nowhere RUNNING with {FEWEST} heights of each strut within "
            f"{_LONGEST_S:g} s and no tick missed between them"
        )
    return forces


def _mobility(run: RunFolder, plan: Plan) -> Array:
    """Second derivative of each height per newton in each strut, in 1/kg."""
    _refuse_unsmoothable(run, plan)
    plant = build_plant(plan)
    if not plant.is_constant:
        raise InputError(
            f"{run.folder}: model {plan.model.name}: smoothing requires a model whose masses move "
            "along straight guides"
        )
    rest_m = [strut.free_length_m for strut in plan.struts]
    mobility = linearise_at(plant, rest_m).mobility_per_kg
    singular = np.linalg.svd(mobility, compute_uv=False)
    if singular[-1] < _SINGULAR * singular[0]:
        raise InputError(f"{run.folder}: model {plan.model.name}: more struts than coordinates")
    return mobility


def _refuse_unsmoothable(run: RunFolder, plan: Plan) -> None:
    """Refuse a run whose configuration does not give the forces."""
    if plan.is_prescribed:
        raise InputError(f"{run.folder}: prescribed_motion: its load cell measures the force")
    if len(plan.struts) > len(plan.heights):
        raise InputError(
            f"{run.folder}: observers: kind none: smoothing requires a measured height on every "
            "strut"
        )
    for strut in plan.struts:
        if strut.interval_ns * _MISSED < plan.period_ns:
            raise InputError(
                f"{run.folder}: height {strut.name}: every {strut.interval_ns} ns, ticks every "
                f"{plan.period_ns} ns: smoothing requires at most one height a tick"
            )


def _strut_columns(run: RunFolder, name: str) -> _StrutColumns:
    if f"{name}.law_force_n" not in run.steps.schema.names:
        raise InputError(f"{run.folder}: has no steps of strut {name}, expected a run with some")

    def column(key: str) -> Array:
        return np.asarray(run.steps.column(f"{name}.{key}").to_numpy(), dtype=np.float64)

    return _StrutColumns(
        column("virtual_force_n"),
        column("law_force_n"),
        column("innovation_m"),
        column("measured_t_ns") * 1e-9,
    )


def _split_at_gaps(tick_s: Array, stretch: slice, missed_s: float) -> list[slice]:
    """Split a stretch where ticks were missed."""
    breaks = np.flatnonzero(np.diff(tick_s[stretch]) > missed_s) + 1 + stretch.start
    edges = [stretch.start, *breaks.tolist(), stretch.stop]
    return [slice(begin, end) for begin, end in itertools.pairwise(edges)]


def _split_long(tick_s: Array, stretch: slice) -> list[tuple[slice, slice]]:
    """Split a stretch into overlapping pieces, each with the part of it that is used."""
    within_s = tick_s[stretch]
    first_s, last_s = float(within_s[0]), float(within_s[-1])

    def tick_at(t_s: float) -> int:
        return stretch.start + int(np.searchsorted(within_s, t_s))

    count = max(1, math.ceil((last_s - first_s) / _LONGEST_S))
    length_s = (last_s - first_s) / count
    edges = [*(tick_at(first_s + k * length_s) for k in range(count)), stretch.stop]
    pieces: list[tuple[slice, slice]] = []
    for begin, end in itertools.pairwise(edges):
        low_s, high_s = tick_s[begin] - 0.5 * _OVERLAP_S, tick_s[end - 1] + 0.5 * _OVERLAP_S
        pieces.append((slice(tick_at(low_s), tick_at(high_s)), slice(begin, end)))
    return pieces


def _residual_forces(
    tick_s: Array, piece: slice, struts: list[_StrutColumns], mobility: Array
) -> list[tuple[Array, Array]] | None:
    """Residual force of each strut at a piece's ticks and its deviation; None if it is short."""
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
        # The smoother also estimates the state at ticks without a height.
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
