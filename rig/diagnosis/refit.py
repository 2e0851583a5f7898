"""A model's own parameters as recordings have them, whether or not they differ from its file's.

A diagnosis corrects what the data call for; who follows a parameter over a hundred runs wants its
value and its interval from every one.
"""

from collections.abc import Sequence
from typing import NamedTuple

from dart_model.spec import ModelSpec
from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.outcome import Estimate
from rig.diagnosis.problem.build import build
from rig.diagnosis.recording import Recording
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import effect_variables, spread
from rig.diagnosis.write_up import Known, estimates_of, linear_corrections


class OwnParameter(NamedTuple):
    """A parameter of a model.

    Attributes:
        strut: Its strut.
        effect: Its effect in the catalogue; empty for the linear part.
        parameter: Its name, with the unit.
        estimate: Its value with a 95 % interval.
    """

    strut: str
    effect: str
    parameter: str
    estimate: Estimate


def refitted(spec: ModelSpec, runs: Sequence[Recording]) -> list[OwnParameter]:
    """The parameters of a model, its laws as they are, fitted to recordings.

    Args:
        spec: The model.
        runs: Recordings.

    Returns:
        Of the linear part those that the recordings can tell apart, and all of the effects'.

    Raises:
        RecordingError: A recording or the model cannot be used.
    """
    problem = build(spec, runs, CRITERIA.blocks, None)
    _, fit = first_fits(problem)
    known = Known(fit, spread(fit))
    found = [
        OwnParameter(item.strut, "", item.parameter, item.total)
        for item in linear_corrections(problem, known)
    ]
    for row in effect_variables(problem, fit):
        item = problem.existing[fit.candidate.kept[row]]
        for name, estimate in estimates_of(problem, known, row, item.name).items():
            strut = spec.struts[item.strut].name
            found.append(OwnParameter(strut, item.name, name, estimate))
    return found
