"""All parameters of a model fitted to recordings, whether or not they differ from its file's.

A diagnosis corrects only what the data call for; to follow a parameter over a hundred runs, its
value and interval are needed from every one.
"""

from collections.abc import Sequence
from typing import NamedTuple

from dart_model.spec import ModelSpec
from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.estimates import FitEstimates, estimates_of
from rig.diagnosis.numerics.blas import with_one_blas_thread
from rig.diagnosis.outcome import Estimate
from rig.diagnosis.problem.build import build
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import effect_variables, fit_covariance
from rig.diagnosis.write_up import linear_corrections
from rig.recordings.recording import Recording


class OwnParameter(NamedTuple):
    """A parameter of a model; `effect` is empty for the linear part."""

    strut: str
    effect: str
    parameter: str
    estimate: Estimate


@with_one_blas_thread
def refit_parameters(spec: ModelSpec, runs: Sequence[Recording]) -> list[OwnParameter]:
    """Identifiable linear parameters and all effects' parameters, fitted to recordings.

    Raises:
        RecordingError: A recording or the model cannot be used.
    """
    problem = build(spec, runs, CRITERIA.blocks, None)
    _, fit = first_fits(problem)
    estimates = FitEstimates(fit, fit_covariance(fit))
    parameters = [
        OwnParameter(item.strut, "", item.parameter, item.total)
        for item in linear_corrections(problem, estimates)
    ]
    for row in effect_variables(problem, fit):
        item = problem.existing[fit.candidate.kept[row]]
        for name, estimate in estimates_of(problem, estimates, row, item.name).items():
            strut = spec.struts[item.strut].name
            parameters.append(OwnParameter(strut, item.name, name, estimate))
    return parameters
