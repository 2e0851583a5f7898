"""How often two records of a damper are said to differ: `python -m tests.dyno.pairs [--pairs N]`.

The second record is of the same damper, or of one with a property changed by 5 %; temperature, zero
of the load cell, lag and sampling rate of both differ at random.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rig.dyno.characterise import characterise_record
from rig.dyno.comparison import compare_dampers, list_not_comparable
from rig.dyno.figures import ForceRecord
from tests.dyno.days import Day, Step
from tests.dyno.population import Damper
from tests.evidence import add_page_option, command_line, table, write_evidence

STEPS = tuple(
    Step(0.025, speed, cycles, 0.7)
    for speed, cycles in (
        (0.2, 6), (0.004, 1), (0.05, 4), (0.1, 5), (0.2, 6), (0.4, 6), (0.8, 8), (0.2, 6),
    )
)  # fmt: skip
"""A speed is run at the beginning, in the middle and at the end, while the damper warms up."""

CHANGES = {
    "none": {},
    "gas": {"gas_n": 1.05},
    "compression": {"below": 0.95, "above": 0.95},
    "rebound": {"below_up": 0.95, "above_up": 0.95},
    "friction": {"friction_n": 1.3},
}
"""Factors of properties; friction is a small part of all forces."""

SIGNS = {
    "gas": ("gas",),
    "compression": ("compression force",),
    "rebound": ("rebound force",),
    "friction": ("friction", "hysteresis"),
}
"""Beginnings of the figures in which a change has to be seen."""


def drawn(rng):
    """A damper and the temperature at which its damping falls, at random."""
    factors = {
        name: getattr(Damper(), name) * float(rng.uniform(0.7, 1.4))
        for name in ("gas_n", "friction_n", "below", "above", "opens", "below_up", "above_up")
    }
    return replace(Damper(), **factors), -float(rng.uniform(0.001, 0.003))


def measured(damper, per_kelvin, rng):
    """A record of a damper on a day at random, characterised."""
    day = Day(
        damper,
        STEPS,
        rate_hz=float(rng.choice([500.0, 1000.0, 2000.0])),
        noise_n=float(rng.uniform(0.5, 3.0)),
        lag_s=float(rng.choice([0.0, 1.0])) * float(rng.uniform(0.5e-3, 5e-3)),
        zero_n=float(rng.uniform(-15.0, 15.0)),
        begins_k=float(rng.uniform(0.0, 10.0)),
        warms_k=float(rng.uniform(4.0, 12.0)),
        per_kelvin=per_kelvin,
    )
    seed = int(rng.integers(1 << 31))
    return characterise_record(
        ForceRecord("a day", *day.record(seed), temperature_c=day.temperatures(seed))
    )


def compared(change, seed):
    """Differences between two records, of which the second has a change."""
    rng = np.random.default_rng(seed)
    damper, per_kelvin = drawn(rng)
    factors = CHANGES[change]
    other = replace(
        damper, **{name: getattr(damper, name) * factor for name, factor in factors.items()}
    )
    records = [measured(it, per_kelvin, rng) for it in (damper, other)]
    return compare_dampers(*records), list_not_comparable(records)


class Seen(NamedTuple):
    """Of pairs with a change how many figures were compared and called different, and how many
    pairs showed it in a figure of its own."""

    pairs: int
    figures: int
    called: int
    seen: int


def study(pairs, changed_pairs, seed, each=map):
    """What was seen of each change."""
    jobs = [
        (change, [seed, number, index])
        for index, change in enumerate(CHANGES)
        for number in range(pairs if change == "none" else changed_pairs)
    ]
    found = {}
    for (change, _), (figures, differing) in zip(jobs, each(one, jobs), strict=True):
        before = found.get(change, Seen(0, 0, 0, 0))
        is_seen = any(name.startswith(SIGNS.get(change, ("?",))) for name in differing)
        new = Seen(1, figures, len(differing), int(is_seen))
        found[change] = Seen(*(a + b for a, b in zip(before, new, strict=True)))
    return found


def one(job):
    """Number of figures that were compared in a pair, and the names of those that differ."""
    differences, _ = compared(*job)
    return len(differences), [item.figure for item in differences if item.differs]


TEXT = """
`rig compare` compares two records of one damper. Here both are simulated test days: sines of eight
steps from 4 mm/s to 0.8 m/s, one speed run three times while the damper warms up by 4 to 12 K, with
rests between. The two days differ at random in the temperature at the beginning (by up to 10 K),
the zero of the load cell (by up to 30 N), the lag of the force (0, or 0.5 to 5 ms), the sampling
rate (500 to 2 000 Hz) and the noise. The damping falls by 0.1 to 0.3 % per kelvin. The dampers'
equations are not those of the evaluation.

With the change *none*, both records are of the same damper: a figure that is called different is
wrong. In the other rows one property of the second damper is changed by 5 % (friction by 30 %), and
a change is seen if a figure of this property is called different.
"""

WORDS = {
    "none": "none",
    "gas": "gas pressure +5 %",
    "compression": "compression damping -5 %",
    "rebound": "rebound damping -5 %",
    "friction": "friction +30 %",
}


def write_page(found):
    """Write the guide's page."""
    rows = [
        (
            WORDS[change],
            it.pairs,
            it.figures,
            f"{it.called} ({100 * it.called / it.figures:.2g} %)",
            "" if change == "none" else f"{it.seen} of {it.pairs}",
        )
        for change, it in found.items()
    ]
    heads = ("change", "pairs", "figures compared", "called different", "change seen")
    write_evidence(
        "dyno-pairs",
        "How often two records of a damper are said to differ",
        TEXT,
        [table(heads, rows)],
        command_line(),
        with_load=False,
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--changed-pairs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    add_page_option(parser)
    given = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        found = study(given.pairs, given.changed_pairs, given.seed, pool.map)
    for change, it in found.items():
        print(f"{change}: {it}")
    if given.page:
        write_page(found)


if __name__ == "__main__":
    main()
