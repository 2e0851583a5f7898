"""Which cases a benchmark consists of."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tests.truth.cases import FAMILIES, FOREIGN_KINDS, make_case
from tests.truth.plant import Case
from tests.truth.simulation import floor_ratios, record

LEAST_RATIO = 5.0
LEAST_RATIO_OUTSIDE = 10.0
ATTEMPTS = 60
SEEDS_PER_GROUP = 100_000


class Slot(NamedTuple):
    """One place in the benchmark; the first fit case drawn for it takes it.

    Attributes:
        group: ``single``, ``pair``, ``triple``, ``complete``, ``outside``, ``foreign``,
            ``faint``.
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


class Counts(NamedTuple):
    """How many cases of each group."""

    single: int
    pair: int
    triple: int
    complete: int
    outside: int
    foreign: int
    faint: int


def slots(counts: Counts, seed: int) -> list[Slot]:
    """All places, groups interleaved so that an interrupted run has something of each."""
    kinds: dict[str, tuple[str, ...]] = {
        "single": FAMILIES,
        "faint": FAMILIES,
        "foreign": tuple(FOREIGN_KINDS),
        # The pair that a first trial of such an attribution got wrong is every fifth.
        "pair": ("friction_and_cubic", "pair", "pair", "pair", "pair"),
    }
    found = [
        (
            (i + 0.5) / count,
            Slot(group, kinds.get(group, (group,))[i % _cycle(kinds, group)], i, seed),
        )
        for group, count in counts._asdict().items()
        for i in range(count)
    ]
    return [slot for _, slot in sorted(found)]


def _cycle(kinds: dict[str, tuple[str, ...]], group: str) -> int:
    return len(kinds.get(group, (group,)))


def _candidates(slot: Slot) -> Iterator[Case]:
    for attempt in range(ATTEMPTS):
        yield make_case(slot.seed * SEEDS_PER_GROUP + slot.index * ATTEMPTS + attempt, slot.kind)


def _is_fit(slot: Slot, case: Case) -> bool:
    if not case.effects:
        return True
    ratios = floor_ratios(case, record(case.bench, case.effects, case.train, case.sensors))
    if slot.group == "faint":
        return bool(np.all(ratios < LEAST_RATIO))
    least = LEAST_RATIO_OUTSIDE if slot.group == "outside" else LEAST_RATIO
    return bool(np.all(ratios >= least))


def fill(slot: Slot) -> Case:
    """The first case for a slot whose effects all stand as high above the floor as they should."""
    for case in _candidates(slot):
        if _is_fit(slot, case):
            return case
    raise RuntimeError(f"{slot.name}: no case of {ATTEMPTS} is visible enough")
