"""Models in free run: before and after correction on held-out data, or one model on some runs.

A free run's heights are DART's, with the applied force as the only input; only the initial state,
which is not measured, is fitted. An observer with a high gain would hide any model error.
"""

from collections.abc import Sequence

import numpy as np

from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.build import Problems, build
from rig.diagnosis.problem.problem import (
    CandidateModel,
    ComparedModels,
    Problem,
    RunEvaluation,
    first_starts,
    nominal,
    nominal_model,
)
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import Fit, fit
from rig.recordings.recording import Recording, RecordingError


def evaluate_model(spec: ModelSpec, recordings: Sequence[Recording]) -> tuple[RunEvaluation, ...]:
    """Figures of a model as it is, of every recording; before and after in them are the same.

    Raises:
        RecordingError: A recording or the model cannot be used, or the model runs away.
    """
    problem = build(spec, recordings, CRITERIA.blocks, None)
    given = fit_as_given(problem)
    models = ComparedModels(given.model, given.model, given.model)
    fitted_rms_n = problem.residual_force_rms_n(given.mean_square)
    return tuple(
        problem.evaluate(k, models, fitted_rms_n, blocks=False) for k in range(problem.recordings)
    )


def fit_as_given(problem: Problem) -> Fit:
    """The nominal model with nothing fitted but its initial states.

    Raises:
        RecordingError: It runs away on the recordings.
    """
    first = nominal_model(problem, first_starts(problem, nominal(problem)))
    none_free = np.zeros(len(problem.linear), dtype=np.bool_)
    given = fit(problem, first, none_free, Effort(8), effects=False)
    if given is None:
        raise RecordingError(
            f"model {problem.spec.name}: runs away on the recordings, expected one that stays "
            "near them: check its stiffness, its free length and the sign of the applied force"
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
    return tuple(
        held_out.evaluate(k, models, fitted_rms_n, blocks=problems.by_blocks)
        for k in range(held_out.recordings)
    )


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
