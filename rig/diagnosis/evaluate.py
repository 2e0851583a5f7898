"""Models before and after correction, on held-out data.

A free run's heights are DART's, with the applied force as the only input; only the initial state,
which is not measured, is fitted. An observer with a high gain would hide any model error.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.build import Problems
from rig.diagnosis.problem.problem import (
    CandidateModel,
    ComparedModels,
    Problem,
    RunEvaluation,
    first_starts,
    nominal_model,
)
from rig.diagnosis.recording import RecordingError
from rig.diagnosis.search.fit import Fit, fit


class HeldOutData(NamedTuple):
    """Held-out data, and the problem that was learnt from.

    Attributes:
        learnt: The problem that models were fitted to.
        held_out: The problem of held-out runs, or that whose blocks were held out.
        by_blocks: Whether blocks were held out; their initial states are those of the fit.
    """

    learnt: Problem
    held_out: Problem
    by_blocks: bool

    def evaluate(self, linear: Fit, corrected: Fit) -> tuple[RunEvaluation, ...]:
        """Figures of every held-out recording.

        Args:
            linear: The best linear model.
            corrected: The corrected model.

        Raises:
            RecordingError: A model runs away on a recording.
        """
        nominal = nominal_model(self.learnt, linear.parts.starts)
        models = ComparedModels(
            *(self._with_fitted_starts(m) for m in (nominal, linear.model, corrected.model))
        )
        fitted_rms_n = self.learnt.residual_force_rms_n(corrected.mean_square)
        return tuple(
            self.held_out.evaluate(k, models, fitted_rms_n, blocks=self.by_blocks)
            for k in range(self.held_out.recordings)
        )

    def _with_fitted_starts(self, model: CandidateModel) -> CandidateModel:
        problem, (candidate, parts) = self.held_out, model
        if not self.by_blocks:
            parts = parts._replace(starts=first_starts(problem, candidate))
        fixed = np.zeros(len(problem.linear), dtype=np.bool_)
        first = CandidateModel(candidate, parts)
        result = fit(problem, first, fixed, Effort(10), effects=False)
        if result is None:
            raise RecordingError(
                f"model {problem.spec.name}: runs away on the held-out runs, expected runs that "
                "stay near the motion it was learnt from"
            )
        return result.model


def held_out_data(problems: Problems, learnt: Problem) -> HeldOutData:
    """Held-out data, with the motions of the problem at the end of the search."""
    held_out = replace(problems.evaluated, motions=learnt.motions)
    return HeldOutData(learnt, held_out, problems.by_blocks)
