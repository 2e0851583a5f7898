"""One diagnosis of the study, in a process of its own."""

from dataclasses import replace
from typing import NamedTuple

from rig.diagnosis.search.criteria import CRITERIA
from tests.criteria_study.cases import Answer, answer

FACTORS = {"half": 0.5, "as is": 1.0, "double": 2.0}


class Task(NamedTuple):
    """One diagnosis: a case with a criterion times a factor; with all as they are if absent."""

    case: str
    criterion: str | None
    factor: str


def moved(criterion: str, factor: str) -> float:
    """A criterion's value times a factor; an integer stays one, and at least 1."""
    value = getattr(CRITERIA, criterion)
    product = FACTORS[factor] * value
    return max(1, int(product + 0.5)) if isinstance(value, int) else product


def run(task: Task) -> Answer:
    """The answer of one diagnosis; one that breaks off is an answer too."""
    criteria = CRITERIA
    if task.criterion is not None:
        criteria = replace(CRITERIA, **{task.criterion: moved(task.criterion, task.factor)})
    try:
        return answer(task.case, criteria)
    except Exception as error:
        return Answer(f"failed: {error!r}", frozenset(), white=False)
