"""Models before and after correction, on held-out data.

A free run's heights are DART's, with the applied force as the only input; only the initial state,
which is not measured, is fitted. An observer with a high gain would hide any model error.
"""

import numpy as np

from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.build import Problems
from rig.diagnosis.problem.problem import (
    CandidateModel,
    ComparedModels,
    RunEvaluation,
    first_starts,
    nominal_model,
)
from rig.diagnosis.search.fit import Fit, fit
from rig.recordings.recording import RecordingError


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
