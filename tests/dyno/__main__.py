"""How often the 95 % intervals hold the truth: `python -m tests.dyno [--cases N]`."""

import argparse
from collections import defaultdict

import numpy as np

from rig.dyno.characterise import ForceRecord, characterise_record
from tests.dyno.dynos import drawn, found


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


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    hits = study(given.cases, given.seed)
    laws = sorted({law for _, law in hits})
    print("share of 95 % intervals that hold the truth; median half width over the value")
    for name in dict.fromkeys(name for name, _ in hits):
        cells = [
            f"{np.mean([r[0] for r in hits[name, law]]):.3f}"
            f" ({100 * np.median([r[2] for r in hits[name, law]]):.2g} %)"
            for law in laws
        ]
        shown = "  ".join(f"{law} {cell}" for law, cell in zip(laws, cells, strict=True))
        print(f"{name:24} all {coverage(hits, name):.3f}  {shown}", flush=True)


if __name__ == "__main__":
    main()
