"""Which smaller or simpler model takes the place of a chosen one."""

from types import SimpleNamespace

import pytest

from rig.diagnosis.progress import no_progress
from rig.diagnosis.search import model_selection
from rig.diagnosis.search.pool import adds_an_imitator


def model(cost, *laws):
    """A model of laws, each of a family, as far as the choice reads it."""
    candidate = SimpleNamespace(new=tuple((0, name) for name, _ in laws))
    families = tuple(sorted(family for _, family in laws))
    return SimpleNamespace(
        cost=cost, families=families, size=len(laws), fit=SimpleNamespace(candidate=candidate)
    )


DAHL, VALVES = ("dahl", "hysteresis"), ("blow_off_damping", "nonlinear_damping")
FRICTION, STOP = ("coulomb_friction", "friction"), ("bump_stop", "stop")


@pytest.fixture
def replace(monkeypatch):
    """The model that stays, of those that lose nothing."""

    def replaced(chosen, smaller=(), simpler=()):
        first = chosen.fit.candidate.new[0]

        def those(models):
            return lambda *args: list(models) if args[1] is chosen and args[2] == first else []

        monkeypatch.setattr(model_selection, "_smaller_models", those(smaller))
        monkeypatch.setattr(model_selection, "_with_one_of", those(simpler))
        monkeypatch.setattr(model_selection, "_neighbours", lambda *_: [])
        pool = SimpleNamespace(prefers=lambda *_: False, problem=None)
        return model_selection._without_superfluous_laws(pool, chosen, no_progress)

    return replaced


def test_of_two_formulas_for_one_effect_the_better_one_stays(replace):
    both = model(100.0, DAHL, FRICTION)
    friction, hysteresis = model(700.0, FRICTION), model(180.0, DAHL)
    assert replace(both, smaller=[friction, hysteresis]) is hysteresis


def test_a_law_is_replaced_by_a_simpler_one(replace):
    chosen, simpler = model(100.0, VALVES, STOP), model(101.0, FRICTION, STOP)
    assert replace(chosen, simpler=[simpler]) is simpler


def test_friction_is_no_simpler_damper_beside_hysteresis(replace):
    chosen, other = model(100.0, DAHL, VALVES), model(101.0, DAHL, FRICTION)
    assert adds_an_imitator(chosen, other)
    assert replace(chosen, simpler=[other]) is chosen
