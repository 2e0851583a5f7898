"""What the regression along the motion looks at: samples of recordings, lines of a residual."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from dart_model.effects import Motion
from rig.diagnosis.problem.build import build, with_tones
from rig.diagnosis.problem.contract import Parts, nominal
from rig.diagnosis.problem.track import most_thinned, pieces
from tests.diagnosis import little_bench, little_dyno


def sine(frequency_hz, rate_hz, samples):
    t_s = np.arange(samples) / rate_hz
    omega = 2.0 * np.pi * frequency_hz
    return t_s, np.sin(omega * t_s), omega * np.cos(omega * t_s)


def motion_of(t_s, z, w):
    speed, top, stroke = float(np.std(w)), float(np.abs(w).max()), float(np.ptp(z))
    step, duration = float(t_s[1]), float(t_s[-1])
    none = (0.0, 0.0)
    return Motion(
        float(z.min()), float(z.max()), speed, top, stroke, duration, step,
        0.0, 1.0, 1.0, 1.0, 1.0, none, (),
    )  # fmt: skip


@given(
    frequency_hz=st.floats(0.5, 100.0),
    rate_hz=st.floats(1000.0, 8000.0),
    most=st.integers(500, 5000),
)
def test_a_motion_is_known_between_the_samples_that_are_kept(frequency_hz, rate_hz, most):
    t_s, z, w = sine(frequency_hz, rate_hz, 20_000)
    thinned = most_thinned([motion_of(t_s, z, w)])
    for cut in pieces(len(t_s), len(t_s), most, thinned):
        if cut.stop - cut.start <= cut.step:
            continue
        known = CubicHermiteSpline(t_s[cut], z[cut], w[cut])
        last = cut.start + (len(t_s[cut]) - 1) * cut.step
        between = slice(cut.start, last + 1)
        assert np.max(np.abs(known(t_s[between]) - z[between])) < 1e-3


@given(
    nodes=st.integers(1000, 200_000),
    most=st.integers(500, 20_000),
    thinned=st.integers(1, 40),
)
def test_about_as_many_samples_are_looked_at_as_are_asked_for(nodes, most, thinned):
    kept = sum(len(range(nodes)[cut]) for cut in pieces(nodes, nodes, most, thinned))
    assert kept <= 2.0 * most + 8
    assert kept >= min(nodes / thinned, 0.7 * most) - 8


@pytest.mark.parametrize("bench", [little_bench, little_dyno])
def test_parts_that_are_kept_back_are_not_looked_at(bench):
    recording = bench.run(bench.Nothing(), duration_s=60.0)
    problem = build(bench.model(), [recording], 32, 5)
    candidate = nominal(problem)
    parts = Parts(np.zeros(len(problem.linear)), np.zeros(0), (problem.start(0, candidate),))
    segments = problem.segments(candidate, parts, 500, 1)
    assert 0 < len(segments) < 8
    assert all(len(segment.target) for segment in segments)


def test_a_slow_line_is_taken_out_and_is_no_tone():
    problem = build(little_dyno.model(), [little_dyno.run(little_dyno.Nothing())], 32, None)
    candidate = nominal(problem)
    parts = Parts(np.zeros(len(problem.linear)), np.zeros(0), (np.zeros(0),))
    forces = problem.residual_forces(0, candidate, parts)
    t_s = forces.track.t_s
    slow_hz, fast_hz = 3.0 / t_s[-1], 31.0 / t_s[-1]
    force_n = np.array(
        [50.0 * np.sin(2 * np.pi * slow_hz * t_s) + np.cos(2 * np.pi * fast_hz * t_s)]
    )
    (motion,) = with_tones(problem, [forces._replace(force_n=force_n)])
    assert all(hz >= 5.0 / t_s[-1] for hz, _ in motion.tones)
    assert motion.tones[0] == pytest.approx((fast_hz, 0.5 * np.pi), rel=0.02)
