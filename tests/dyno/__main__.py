"""How often the 95 % intervals hold the truth: `python -m tests.dyno [--cases N]`."""

import argparse
from collections import defaultdict

import numpy as np

from rig.dyno.characterise import ForceRecord, characterise_record
from tests.dyno.dynos import drawn, found
from tests.evidence import add_page_option, command_line, table, write_evidence

TEXT = """
{cases} records of sine tests are simulated. Frequency (0.3 to 4 Hz), amplitude (8 to 30 mm), number
of cycles (5 to 15), samples per cycle (16 to 400) and phase are drawn at random, and so is the
white noise: that of the force is 0.2, 1 or 3 % of the damping force at mid-stroke, that of the
height 0.01 or 0.1 % of the amplitude. Each record has one of four laws with fixed parameters:

- digressive: a digressive damper, stronger in rebound, and a linear gas force,
- friction: a linear damper with Coulomb friction, and a linear gas force,
- gas: a linear damper and a polytropic gas spring,
- linear: a linear damper and a linear gas force.

`rig characterise` computes the figures of each record with 95 % intervals; the true values are
known. The table gives the share of the intervals that contain the true value, over all laws and for
each law. The median half width of the intervals is in parentheses, in percent of the true value,
unless the true value is zero. Correlated noise and the errors of a real sensor are not part of this
study.

*Window* is the mean force in a window about mid-stroke, *peak* the largest force, *energy* that of
a cycle. *Mean force* and *half difference* are half the sum and half the difference of the forces
in compression and in rebound at mid-stroke; *hysteresis at the turning points* is the force in
compression less that in rebound at zero velocity.
"""


def study(cases, seed):
    """Hits, errors over half widths, and errors over values, by figure and law."""
    rng = np.random.default_rng(seed)
    hits = defaultdict(list)
    for _ in range(cases):
        dyno = drawn(rng)
        [step] = characterise_record(ForceRecord("drawn", *dyno.record(rng))).steps
        figures = found(step)
        for name, truth in dyno.truth().items():
            pairs = zip(np.atleast_1d(truth), _each(figures[name]), strict=True)
            for value, figure in pairs:
                half = 0.5 * (figure.high - figure.low)
                hits[name, dyno.law].append(
                    (figure.low <= value <= figure.high, abs(figure.value - value) / half,
                     half / max(abs(value), 1e-9))
                )  # fmt: skip
    return hits


def _each(figures):
    return figures if isinstance(figures, tuple) and not hasattr(figures, "low") else [figures]


def coverage(hits, name):
    """Share of the intervals of a figure that hold the truth, over all laws."""
    return float(np.mean([hit for (of, _), rows in hits.items() if of == name for hit, *_ in rows]))


def cell(rows):
    """Share of the intervals that hold the truth, and median half width over a value not zero."""
    share, width = np.mean([row[0] for row in rows]), np.median([row[2] for row in rows])
    return f"{share:.3f} ({100 * width:.2g} %)" if width < 10.0 else f"{share:.3f}"


def write_page(hits, cases):
    """Write the guide's page."""
    laws = sorted({law for _, law in hits})
    rows = [
        (
            name.replace("_", " "),
            f"{coverage(hits, name):.3f}",
            *(cell(hits[name, law]) for law in laws),
        )
        for name in dict.fromkeys(name for name, _ in hits)
    ]
    write_evidence(
        "dyno-intervals",
        "How often the intervals of a damper's figures are right",
        TEXT.format(cases=cases),
        [table(("figure", "all", *laws), rows)],
        command_line(),
        with_load=False,
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    add_page_option(parser)
    given = parser.parse_args()
    hits = study(given.cases, given.seed)
    laws = sorted({law for _, law in hits})
    print("share of 95 % intervals that hold the truth; median half width over the value")
    for name in dict.fromkeys(name for name, _ in hits):
        shown = "  ".join(f"{law} {cell(hits[name, law])}" for law in laws)
        print(f"{name:24} all {coverage(hits, name):.3f}  {shown}", flush=True)
    if given.page:
        write_page(hits, given.cases)


if __name__ == "__main__":
    main()
