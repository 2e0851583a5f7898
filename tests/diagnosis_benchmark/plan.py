"""Which cases a benchmark consists of."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tests.diagnosis_benchmark import moving
from tests.diagnosis_benchmark.moving import MovingCase, make_moving, moving_ratios
from tests.truth import dyno
from tests.truth.cases import FAMILIES, FOREIGN_KINDS, NONLINEAR_FAMILIES, make_case
from tests.truth.plant import Case
from tests.truth.simulation import floor_ratios, record

LEAST_RATIO = 5.0
LEAST_RATIO_OUTSIDE = 10.0
ATTEMPTS = 60
SEEDS_PER_GROUP = 100_000


class Group(NamedTuple):
    """Cases of one sort.

    Attributes:
        cases: How many by default.
        kinds: As for `make_case`, in turn.
        says: What they are.
    """

    cases: int
    kinds: tuple[str, ...]
    says: str


# The pair that a first trial of such an attribution got wrong is every fifth.
_PAIRS = ("friction_and_cubic", "pair", "pair", "pair", "pair")

GROUPS = {
    "single": Group(100, FAMILIES, "one effect above the floor"),
    "pair": Group(25, _PAIRS, "two effects"),
    "triple": Group(15, ("triple",), "three effects"),
    "complete": Group(40, ("complete",), "nothing planted"),
    "outside": Group(20, ("outside",), "a force that no catalogue holds"),
    "foreign": Group(25, tuple(FOREIGN_KINDS), "a formula that no catalogue holds"),
    "rough": Group(
        75, tuple(f"rough_{f}" for f in NONLINEAR_FAMILIES), "one effect, rough nominal model"
    ),
    "rough_pair": Group(
        20, tuple(f"rough_{kind}" for kind in _PAIRS), "two effects, rough nominal model"
    ),
    "rough_triple": Group(10, ("rough_triple",), "three effects, rough nominal model"),
    "rough_complete": Group(40, ("rough_complete",), "nothing but a rough nominal model"),
    "rough_foreign": Group(
        20, tuple(f"rough_{kind}" for kind in FOREIGN_KINDS), "kept-back formula, rough model"
    ),
    "dyno": Group(
        45, tuple(f"dyno_{f}" for f in dyno.FAMILIES), "one effect on a dyno, half rough"
    ),
    "dyno_pair": Group(10, ("dyno_pair",), "two effects on a dyno, half rough"),
    "dyno_complete": Group(20, ("dyno_complete",), "nothing planted on a dyno, half rough"),
    "moving": Group(45, moving.KINDS[:2], "one to three effects, base moved, rough nominal model"),
    "posts": Group(15, moving.KINDS[2:], "the same in a car on four posts"),
    "faint": Group(0, FAMILIES, "one effect below five times the floor"),
    "stops": Group(40, ("stop", "rough_stop"), "a stop, half rough: where it shows"),
    "disturbed": Group(
        0,
        ("disturbed", "rough_disturbed", "dyno_disturbed"),
        "nothing but coloured noise and a late height",
    ),
}


class Slot(NamedTuple):
    """One place in the benchmark; the first fit case drawn for it takes it.

    Attributes:
        group: One of `GROUPS`.
        kind: As for `make_case`.
        index: Within its group.
        seed: Of the benchmark.
    """

    group: str
    kind: str
    index: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.group}-{self.index:03d}-{self.kind}"


Counts = dict[str, int]
"""Group -> number of cases; what is not named has none."""


def part_of(counts: Counts, divisor: int) -> Counts:
    """About one case of so many of each group, one at least of each group that has any."""
    return {
        group: max(1, round(count / divisor)) if count else 0 for group, count in counts.items()
    }


def slots(counts: Counts, seed: int) -> list[Slot]:
    """All places, groups interleaved so that an interrupted run has something of each."""
    found = [
        ((i + 0.5) / count, Slot(group, _kind(group, i, count), i, seed))
        for group, count in counts.items()
        for i in range(count)
    ]
    return [slot for _, slot in sorted(found)]


def _kind(group: str, index: int, count: int) -> str:
    """Kinds in turn, or spread over all where there are fewer cases than kinds."""
    kinds = GROUPS[group].kinds
    return kinds[index * len(kinds) // count if count < len(kinds) else index % len(kinds)]


def _candidates(slot: Slot) -> Iterator[Case | MovingCase]:
    make = make_moving if slot.kind in moving.KINDS else make_case
    for attempt in range(ATTEMPTS):
        yield make(slot.seed * SEEDS_PER_GROUP + slot.index * ATTEMPTS + attempt, slot.kind)


def ratios_of(case: Case | MovingCase) -> tuple[float, ...]:
    """How far each effect of a case stands above the noise floor."""
    if isinstance(case, MovingCase):
        return moving_ratios(case)
    return tuple(float(ratio) for ratio in floor_ratios(case, record(case, case.train)))


def _is_fit(slot: Slot, case: Case | MovingCase) -> bool:
    if not case.effects:
        return True
    ratios = np.array(ratios_of(case))
    if slot.group == "faint":
        return bool(np.all(ratios < LEAST_RATIO))
    least = LEAST_RATIO_OUTSIDE if slot.group == "outside" else LEAST_RATIO
    return bool(np.all(ratios >= least))


def fill(slot: Slot) -> Case | MovingCase:
    """The first case for a slot whose effects all stand as high above the floor as they should."""
    for case in _candidates(slot):
        if _is_fit(slot, case):
            return case
    raise RuntimeError(f"{slot.name}: no case of {ATTEMPTS} is visible enough")
