"""Edges of play that the motion reaches, and edges that it does not."""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.open_edges import UnreachedEdge, open_parameters, open_preload
from rig.diagnosis.outcome import Estimate
from tests.diagnosis.little_bench import STIFFNESS, Nothing, load_n, model, run


class Play(Nothing):
    """Its spring does not act between two heights."""

    fine = 32

    def __init__(self, low_m, high_m):
        self.middle_m, self.half_m = 0.5 * (low_m + high_m), 0.5 * (high_m - low_m)

    def force(self, t, z, v, state):
        return STIFFNESS * min(max(z - self.middle_m, -self.half_m), self.half_m)


@cache
def diagnosed(low_m, width_m, scale):
    """Diagnosis of the bench with play that begins on the lower side, and its largest height."""
    loads = (lambda t: scale * load_n(t), lambda t: scale * load_n(t + 40.0))
    runs = [
        run(Play(low_m, low_m + width_m), seed, load=load, duration_s=20.0, start=0.3)
        for seed, load in enumerate(loads, 1)
    ]
    return diagnose(model(), runs[:1], runs[1:]).diagnosis, float(runs[0].heights_m.max())


def bounds(estimate):
    low, high = estimate.low, estimate.high
    return -math.inf if low is None else low, math.inf if high is None else high


@pytest.mark.parametrize(
    ("low_m", "scale"), [(0.3, 0.8), pytest.param(0.29, 0.5, marks=pytest.mark.slow)]
)
def test_the_width_of_a_play_that_is_not_crossed_is_open_to_above(low_m, scale):
    diagnosis, highest_m = diagnosed(low_m, 0.15, scale)
    (play,) = diagnosis.effects
    assert play.family == "backlash"
    gap, centre = play.parameters["gap_m"], play.parameters["centre_height_m"]
    assert gap.high is None
    assert centre.high is None
    # As wide as what was crossed of it, at least.
    assert gap.low == pytest.approx(highest_m - low_m, abs=3e-5)
    assert gap.low < 0.15
    assert centre.low < low_m + 0.075
    (note,) = (note for note in diagnosis.notes if "edge" in note)
    assert note.startswith(f"The upper edge of {play.name} of strut strut was not reached")


def test_a_preload_that_the_width_decides_is_open_too():
    """Below the play, its spring has the force of a longer one."""
    diagnosis, _ = diagnosed(0.3, 0.15, 0.8)
    (preload,) = (item for item in diagnosis.linear if item.parameter == "preload_n")
    low, high = bounds(preload.total)
    assert low < 0.0 < high == math.inf
    assert not any("preload_n is" in note for note in diagnosis.notes)


@pytest.mark.slow
def test_a_play_with_both_edges_met_is_known_on_both_sides():
    diagnosis, _ = diagnosed(0.33, 0.08, 1.5)
    (play,) = diagnosis.effects
    low, high = bounds(play.parameters["gap_m"])
    assert low < 0.08 < high
    assert high - low < 1e-4
    assert not any("edge" in note for note in diagnosis.notes)


HEIGHTS = st.floats(-1.0, 1.0)
WIDTHS = st.floats(1e-3, 1.0)


@given(low=HEIGHTS, gap=WIDTHS, half=st.floats(1e-6, 1e-3), off=st.floats(-1.0, 1.0), more=WIDTHS)
def test_intervals_contain_every_play_with_an_edge_beyond(low, gap, half, off, more):
    """Whatever the lower edge is within its interval, and the upper one beyond its least."""
    unreached = [UnreachedEdge(1, low + gap, low + gap, 0.0)]
    fitted = {"centre_height_m": Estimate(low + 0.5 * gap, None, None)}
    fitted["gap_m"] = Estimate(gap, None, None)
    values, halves = np.array([low + 0.5 * gap, gap]), np.array([half, half])
    opened = open_parameters("free_play", values, halves, unreached, fitted)
    edges = low + off * half, low + gap + more
    truth = {"centre_height_m": 0.5 * sum(edges), "gap_m": edges[1] - edges[0]}
    for name, value in truth.items():
        least, most = bounds(opened[name])
        assert least - 1e-9 <= value <= most
        assert opened[name].value == fitted[name].value


def test_of_two_stops_only_the_one_that_was_not_reached_is_open():
    unreached = [UnreachedEdge(-1, 0.2, 0.21, 0.0)]
    names = ("low_contact_height_m", "high_contact_height_m", "stiffness_n_per_m")
    fitted = {name: Estimate(1.0, 0.9, 1.1) for name in names}
    values, halves = np.array([0.2, 0.4, 1e5, 0.0]), np.array([1e-3, 1e-3])
    opened = open_parameters("end_stops", values, halves, unreached, fitted)
    assert opened["low_contact_height_m"] == Estimate(1.0, None, 0.21)
    assert opened["high_contact_height_m"] == fitted["high_contact_height_m"]
    assert opened["stiffness_n_per_m"] == fitted["stiffness_n_per_m"]


@pytest.mark.parametrize(("force_n_per_m", "ends"), [(50.0, (9.5, None)), (-50.0, (None, 10.5))])
def test_a_preload_makes_up_for_a_play_that_is_wider(force_n_per_m, ends):
    edge = UnreachedEdge(1, 0.32, 0.31, force_n_per_m)
    found = open_preload(Estimate(10.0, 9.9, 10.1), [edge])
    assert (found.low, found.high) == pytest.approx(ends)
    assert open_preload(found, []) == found
