"""Models in free run: before and after correction on held-out data, or one model on some runs.

A free run's heights are DART's, driven by the measured inputs alone; only the initial state,
which is not measured, is fitted. An observer with a high gain would hide any model error.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.outcome import HeldOutSeries, ModelErrors, NoiseFloor, RunFigures
from rig.diagnosis.problem.build import Problems, build
from rig.diagnosis.problem.problem import (
    CandidateModel,
    ComparedModels,
    Problem,
    RunEvaluation,
    StrutEffect,
    first_starts,
    free_linear,
    nominal,
    nominal_model,
    quadratic_mean,
    quadratic_means,
    select_nodes,
)
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import Fit, fit, model_for, whiten_residual
from rig.recordings.recording import Recording, RecordingError

Array = NDArray[np.float64]


def evaluate_model(spec: ModelSpec, recordings: Sequence[Recording]) -> tuple[RunEvaluation, ...]:
    """Figures of a model as it is, of every recording; before and after in them are the same.

    Raises:
        RecordingError: A recording or the model cannot be used, or the model runs away.
    """
    problem = build(spec, recordings, CRITERIA.blocks, None)
    given = fit_as_given(problem)
    models = ComparedModels(given.model, given.model, given.model)
    fitted_rms_n = problem.residual_force_rms_n(given.mean_square)
    return _evaluate(problem, models, fitted_rms_n, blocks=False)


def fit_as_given(problem: Problem) -> Fit:
    """The nominal model with nothing fitted but its initial states.

    Raises:
        RecordingError: It runs away on the recordings.
    """
    first = nominal_model(problem, first_starts(problem, nominal(problem)))
    none_free = np.zeros(len(problem.linear), dtype=np.bool_)
    given = fit(problem, first, none_free, Effort(8), effects=False)
    if given is None:
        names = ", ".join(dict.fromkeys(grid.name for grid in problem.grids))
        raise RecordingError(
            f"model {problem.spec.name}: runs away on {names}, expected a model that stays near "
            "it: check its stiffness, its free length and the sign of the applied force"
        )
    return given


def evaluate_held_out(problems: Problems, linear: Fit, corrected: Fit) -> tuple[RunEvaluation, ...]:
    """Figures of every held-out recording.

    Raises:
        RecordingError: A model runs away on a recording.
    """
    held_out = problems.held_out
    nominal = nominal_model(problems.learnt, linear.parts.starts)
    models = ComparedModels(
        *(_fit_starts(problems, m) for m in (nominal, linear.model, corrected.model))
    )
    fitted_rms_n = problems.learnt.residual_force_rms_n(corrected.mean_square)
    return _evaluate(held_out, models, fitted_rms_n, blocks=problems.by_blocks)


class HeldOutLaw(NamedTuple):
    """What held-out data say of a law, corrections of the linear part being free.

    Attributes:
        power: Twice the gain in log likelihood that is expected if the law is right.
        gain: Twice the gain in log likelihood over the model without it.
    """

    power: float
    gain: float


def weigh_on_held_out(problems: Problems, corrected: Fit) -> dict[StrutEffect, HeldOutLaw]:
    """What held-out data say of each law of a model.

    The noise is what the model leaves, at least that of the sensors. The response to a law is
    projected on what no change of linear parameters and initial states gives, by linearisation. A
    law without which the model runs away gains without bound.
    """
    problem, model = problems.held_out, corrected.model
    if not model.candidate.new:
        return {}
    if problems.by_blocks:
        starts = zip(model.parts.starts, problem.grids, strict=True)
        parts = model.parts._replace(
            starts=tuple(start for start, grid in starts if np.any(grid.held_out))
        )
        model, problem = model._replace(parts=parts), problem.of_held_out_blocks()
    else:
        model = _fit_starts(problems, model)
    free = free_linear(problem, model.candidate)
    base = fit(problem, model, free, Effort(0, sides=1), effects=False)
    if base is None:
        return {}
    level = max(1.0, base.mean_square)
    nuisance = base.solution.jacobian
    size = np.linalg.norm(nuisance, axis=0)
    basis = np.linalg.qr(nuisance[:, size > 0.0] / size[size > 0.0])[0]

    def apart(rows: Array) -> float:
        rest = rows - basis @ (basis.T @ rows)
        return float(rest @ rest) / level

    found: dict[StrutEffect, HeldOutLaw] = {}
    for law in model.candidate.new:
        less = model_for(problem, model, model.candidate.without(law))
        residual = whiten_residual(problem, less)
        if residual is None:
            found[law] = HeldOutLaw(np.inf, np.inf)
        else:
            gain = apart(residual) - apart(base.residual)
            found[law] = HeldOutLaw(apart(residual - base.residual), gain)
    return found


def _evaluate(
    problem: Problem, models: ComparedModels, fitted_rms_n: float, *, blocks: bool
) -> tuple[RunEvaluation, ...]:
    """Figures of every recording, from those of its pieces."""
    pieces: dict[int, list[tuple[int, RunEvaluation]]] = {}
    for k, grid in enumerate(problem.grids):
        nodes = int(np.sum(select_nodes(grid, blocks=blocks)))
        if nodes:
            figures = problem.evaluate(k, models, fitted_rms_n, blocks=blocks)
            pieces.setdefault(grid.recording, []).append((nodes, figures))
    return tuple(_join(*zip(*parts, strict=True)) for parts in pieces.values())


def _join(nodes: Sequence[int], pieces: Sequence[RunEvaluation]) -> RunEvaluation:
    """Figures of a recording: quadratic means over its pieces, by the number of their nodes."""
    if len(pieces) == 1:
        return pieces[0]

    def mean(values: Sequence[float]) -> float:
        return quadratic_mean(values, nodes)

    def means(errors: Sequence[ModelErrors]) -> ModelErrors:
        return quadratic_means(errors, nodes)

    figures = [piece.figures for piece in pieces]
    cells = [it.strut_force_rmse_n for it in figures if it.strut_force_rmse_n is not None]
    return RunEvaluation(
        RunFigures(
            figures[0].run,
            means([it.height_rmse_m for it in figures]),
            means([it.residual_force_rmse_n for it in figures]),
            means(cells) if len(cells) == len(figures) else None,
        ),
        NoiseFloor(
            mean([piece.floor.height_rmse_m for piece in pieces]),
            mean([piece.floor.residual_force_rmse_n for piece in pieces]),
        ),
        mean([piece.drift_m for piece in pieces]),
        tuple(map(_join_series, zip(*(piece.series for piece in pieces), strict=True))),
    )


def _join_series(pieces: Sequence[HeldOutSeries]) -> HeldOutSeries:
    """The pieces of a series one after another, with a gap of NaN between two."""

    def join(name: str) -> Array:
        parts = [getattr(pieces[0], name)]
        for last, piece in itertools.pairwise(pieces):
            middle = 0.5 * (last.t_s[-1] + piece.t_s[0]) if name == "t_s" else np.nan
            parts += [np.array([middle]), getattr(piece, name)]
        return np.concatenate(parts)

    columns = ("t_s", "measured", "before", "after", "height_m", "velocity_m_per_s")
    return dataclasses.replace(pieces[0], **{name: join(name) for name in columns})


def _fit_starts(problems: Problems, model: CandidateModel) -> CandidateModel:
    """A model with initial states fitted to held-out runs; to blocks, from those of its fit."""
    problem, (candidate, parts) = problems.held_out, model
    if not problems.by_blocks:
        parts = parts._replace(starts=first_starts(problem, candidate))
    fixed = np.zeros(len(problem.linear), dtype=np.bool_)
    result = fit(problem, CandidateModel(candidate, parts), fixed, Effort(10), effects=False)
    if result is None:
        raise RecordingError(
            f"model {problem.spec.name}: runs away on the held-out runs, expected runs that stay "
            "near the motion it was learnt from"
        )
    return result.model
