"""A damper whose directions differ: what both have in common is the linear damping."""

import pytest

from rig.diagnosis.diagnose import diagnose
from tests.diagnosis import little_bench as bench


class OneWay(bench.Nothing):
    """Further damping in N·s/m of each direction."""

    def __init__(self, compression, rebound):
        self.compression, self.rebound = compression, rebound

    def force(self, t, z, v, state):
        return -(self.compression if v < 0.0 else self.rebound) * v


@pytest.mark.parametrize(
    ("effect", "nominal", "damping", "law"),
    [
        pytest.param(OneWay(40.0, 0.0), 70.0, None, (40.0, 0.0), id="exact model"),
        pytest.param(OneWay(40.0, 0.0), 100.0, 70.0, (40.0, 0.0), id="damping too large"),
        pytest.param(OneWay(20.0, 60.0), 70.0, 90.0, (0.0, 40.0), id="both directions"),
    ],
)
def test_the_law_acts_in_one_direction(effect, nominal, damping, law):
    runs = [bench.run(effect, seed=seed) for seed in (1, 2)]
    result = diagnose(bench.model(damping=nominal), runs[:1], runs[1:])
    found = result.diagnosis
    assert found.verdict == "explained"
    (one,) = found.effects
    assert one.name == "asymmetric_damping"
    for estimate, truth in zip(one.parameters.values(), law, strict=True):
        assert estimate.low - 1e-9 <= truth <= estimate.high + 1e-9
        assert estimate.value == pytest.approx(truth, abs=0.2)
    dampings = [item for item in found.linear if item.parameter == "damping_n_s_per_m"]
    assert len(dampings) == (damping is not None)
    for item in dampings:
        assert item.nominal == nominal
        assert item.total.low < damping < item.total.high
    (strut,) = result.corrected.struts
    (written,) = (item for item in strut.effects if item.name == "asymmetric_damping")
    assert strut.damping_n_s_per_m == pytest.approx(damping or nominal, rel=0.01)
    assert written.parameters["compression_n_s_per_m"] == pytest.approx(law[0], abs=0.2)
    for row in found.damper:
        further = effect.compression if row.velocity_m_per_s < 0.0 else effect.rebound
        assert row.damping_n_s_per_m.value == pytest.approx(bench.DAMPING + further, rel=0.01)
        assert row.damping_n_s_per_m.low < row.damping_n_s_per_m.high
