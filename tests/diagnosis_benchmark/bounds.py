"""What the figures must be; all numbers that decide whether a benchmark passes.

A share counts as outside only where its own 95 % interval lies there as a whole, so the same bounds
hold for a part of the cases, and bind harder the more there are. Times are no bounds: they are the
machine's as much as the program's.
"""

from typing import NamedTuple

from tests.diagnosis_benchmark.summary import Rate


class Bound(NamedTuple):
    """What one figure of one pool must be.

    Attributes:
        pool: One of ``POOLS`` or of ``GROUPS``.
        figure: A key of `figures`.
        least: Lower end.
        most: Upper end.
        meaning: What it stands for.
    """

    pool: str
    figure: str
    least: float
    most: float
    meaning: str


BOUNDS = (
    Bound("one effect", "right", 0.99, 1.0, "the family of a single effect is named first"),
    Bound("several effects", "right", 0.95, 1.0, "all of two or three families are named"),
    Bound("nothing planted", "right", 0.995, 1.0, "a model that lacks nothing is left alone"),
    Bound("foreign formula", "right", 0.85, 1.0, "a family is known by a formula nobody wrote"),
    Bound("outside", "right", 0.95, 1.0, "no law is claimed for what no catalogue holds"),
    Bound("base moved", "right", 0.95, 1.0, "effects are found where the base is moved"),
    Bound("all but outside", "false_names", 0.0, 0.005, "no family is named that is not there"),
    Bound("nothing planted", "false_names", 0.0, 0.01, "the level that is asked for"),
    Bound("disturbed", "false_names", 0.0, 0.01, "coloured noise and a late height are no law"),
    Bound("all", "explained_within", 1.0, 1.0, "explained means at the floor on held-out data"),
    *(
        Bound(pool, "coverage", 0.93, 0.97, "95 % intervals are honest, and not idle")
        for pool in ("one effect", "several effects", "base moved", "all")
    ),
    Bound("all", "overlap_mean", 0.8, 1.0, "where an effect shows is where it was planted"),
    Bound("all", "runs_live", 0.99, 1.0, "a corrected model follows its bench live"),
    Bound("all", "unbound", 0.0, 0.0, "no effect is named that may be nothing"),
)


def violations(summary: dict, bounds: tuple[Bound, ...] = BOUNDS) -> list[str]:
    """One line for each bound that a summary violates; what was not run violates none."""
    every = summary["groups"] | summary["pools"]
    found = []
    for bound in bounds:
        value = every.get(bound.pool, {}).get(bound.figure)
        low, high = (value.low, value.high) if isinstance(value, Rate) else (value, value)
        if low is None or (bound.least <= high and low <= bound.most):
            continue
        wanted = f"{bound.least:g} to {bound.most:g}"
        shown = str(value) if isinstance(value, Rate) else f"{value:.1f}"
        found.append(f"{bound.pool}: {bound.figure} {shown}, not {wanted}: {bound.meaning}")
    return found
