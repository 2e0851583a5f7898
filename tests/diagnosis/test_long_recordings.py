"""Long recordings are searched in pieces; what is found is fitted to all of them."""

import math

import numpy as np
import pytest

from rig.diagnosis import diagnose as module
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.problem.build import build, part_of
from tests.diagnosis import little_bench as bench
from tests.diagnosis.answers import holds, is_at_the_floor, missing, named
from tests.diagnosis.little_bench import load_n
from tests.diagnosis.test_planted_effects import Friction, Hardening

SEARCHED = 4000
LONG = {"duration_s": 48.0}
DEEP_M = 0.3
PUSH_S = 4.3


@pytest.fixture(autouse=True)
def _few_nodes(monkeypatch):
    monkeypatch.setattr(module, "_SEARCHED_NODES", SEARCHED)


class DeepStop(bench.Nothing):
    """A stop that the usual load does not reach."""

    def force(self, t, z, v, state):
        return 3e4 * max(0.0, DEEP_M - z)


def pushed_n(t):
    """The usual load, and one push that reaches the stop."""
    return load_n(t) - 120.0 * math.exp(-(((t - PUSH_S) / 0.15) ** 2))


@pytest.mark.parametrize(
    ("effect", "family", "parameter", "truth"),
    [
        (Friction, "friction", "coulomb_force_n", 6.0),
        (Hardening, "nonlinear_stiffness", "stiffness_n_per_m3", 1.2e5),
    ],
)
@pytest.mark.long
def test_what_pieces_show_is_found_and_fitted_to_all(effect, family, parameter, truth):
    runs = [bench.run(effect(), **LONG), bench.run(effect(), seed=2)]
    found = diagnose(bench.model(stiffness=2300.0), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "explained"
    assert is_at_the_floor(found)
    assert holds(named(found, family).parameters[parameter], truth, 0.01)


@pytest.mark.slow
def test_what_no_piece_shows_is_searched_for_in_all():
    runs = [
        bench.run(DeepStop(), load=pushed_n, **LONG),
        bench.run(DeepStop(), seed=2, load=pushed_n),
    ]
    heights_m = runs[0].heights_m[:, 0]
    problem = build(bench.model(), runs[:1], 32, None)
    part = part_of(problem, SEARCHED)
    assert heights_m.min() < DEEP_M < min(np.nanmin(grid.heights_m) for grid in part.grids)
    found = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    assert [name.endswith("bump_stop") for name in missing(found)] == [True]
    assert is_at_the_floor(found)
