"""The evidence for a law: what chance gains as often as stated, and what it does not gain."""

import inspect
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from rig.cli.diagnose import diagnose as command
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.outcome import Estimate, LikelihoodGain
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.evidence import LeftOutGains, are_by_chance
from rig.diagnosis.search.pool import error_ratio
from tests.cli.test_commands import rig
from tests.diagnosis import little_bench as bench
from tests.diagnosis.test_metamorphic import Hardening

BLOCKS = 32


class Costs(NamedTuple):
    """Sums of squares of a model's residual in each block."""

    block_costs: np.ndarray

    @property
    def cost(self):
        return float(self.block_costs.sum())


def draw(rng, gain, scatter=0.05):
    """A law's model and that without it, which is worse by a share with scatter in each block."""
    noise = rng.chisquare(200, BLOCKS)
    return Costs(noise), Costs(noise * (1.0 + gain + scatter * rng.standard_normal(BLOCKS)))


@pytest.mark.parametrize("level", [0.05, 0.2])
def test_chance_gains_as_often_as_stated(level):
    rng = np.random.default_rng(1)
    pairs = (draw(rng, 0.0) for _ in range(4000))
    share = np.mean([error_ratio(without, law, level).low > 1.0 for law, without in pairs])
    # Two standard errors of a share of 4000 draws, and a tenth for blocks of unequal weight.
    assert abs(share - level) < 2.0 * np.sqrt(level / 4000) + 0.1 * level


def test_a_gain_in_all_blocks_is_no_chance_and_its_ratio_is_that_of_the_residuals():
    law, without = draw(np.random.default_rng(2), 0.21, scatter=0.02)
    ratio = error_ratio(without, law, 1e-4)
    assert ratio.value == pytest.approx(1.1, abs=0.01)
    assert 1.0 < ratio.low < ratio.value < ratio.high


def gains(ratio):
    return LeftOutGains(LikelihoodGain((), 5.0, Estimate(*ratio)), None)


@pytest.mark.parametrize("is_far", [False, True])
def test_beyond_some_floors_a_candidate_needs_to_be_better_than_by_chance_by_itself(is_far):
    """Level 1 %; of many laws one in a thousand gains that much."""
    law, without = draw(np.random.default_rng(2), 0.21, scatter=0.02)
    surely = gains(error_ratio(without, law, 1e-4))
    perhaps = LeftOutGains(LikelihoodGain((), 4.0, Estimate(1.1, 0.99, 1.2)), None, True)
    hardly = perhaps._replace(is_better=False)
    floors = 1.01 * CRITERIA.settled if is_far else 0.99 * CRITERIA.settled
    pool = SimpleNamespace(criteria=CRITERIA, floor=lambda _: 1000.0)
    chosen = SimpleNamespace(cost=floors**2 * 1000.0)

    def by_chance(*each):
        return are_by_chance(pool, chosen, dict(enumerate(each)))

    assert not by_chance(surely)
    assert by_chance(surely, perhaps) is not is_far
    assert by_chance(perhaps, surely) is not is_far
    assert by_chance(surely, hardly)
    assert by_chance(perhaps)


def test_what_happens_once_may_be_chance():
    law, without = draw(np.random.default_rng(3), 0.0, scatter=0.0)
    without.block_costs[7] *= 1000.0
    assert gains(error_ratio(without, law, 1e-3)).is_by_chance
    without.block_costs[19] *= 1000.0
    assert not gains(error_ratio(without, law, 1e-3)).is_by_chance


def test_a_block_that_gains_most_does_not_hide_what_all_others_gain():
    law, without = draw(np.random.default_rng(4), 3.0)
    before = error_ratio(without, law, 1e-4).value
    without.block_costs[7] *= 1000.0
    ratio = error_ratio(without, law, 1e-4)
    assert not gains(ratio).is_by_chance
    assert ratio.value == pytest.approx(before * 1000.0 ** (0.5 / BLOCKS), rel=0.01)


def test_a_block_that_the_law_misses_does_not_hide_what_it_gains_in_all_others():
    law, without = draw(np.random.default_rng(6), 1e4)
    law.block_costs[7] *= 1e6  # A free run that has parted from the measurement there.
    ratio = error_ratio(without, law, 1e-4)
    assert not gains(ratio).is_by_chance
    assert ratio.value > 10.0


@pytest.mark.slow
def test_at_a_level_that_no_data_reach_nothing_is_named():
    runs = [bench.run(Hardening(), seed=seed) for seed in (1, 2)]
    usual = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    assert [found.family for found in usual.effects] == ["nonlinear_stiffness"]
    assert usual.level == CRITERIA.level
    strict = replace(CRITERIA, level=1e-60)
    found = diagnose(bench.model(), runs[:1], runs[1:], criteria=strict).diagnosis
    assert not any(item.evidence for item in found.effects)
    assert any("chance gains as much" in item.why for item in found.rejected)


def test_the_commands_level_is_that_of_the_criteria_and_has_bounds(tmp_path, monkeypatch, capsys):
    assert inspect.signature(command).parameters["level"].default == CRITERIA.level
    given = ("x.csv", "--model", "reference", "--out", tmp_path, "--level", "0.5")
    assert rig(monkeypatch, "diagnose", *given) == 2
    assert "--level 0.5: expected less than or equal to 0.2" in capsys.readouterr().err
