"""What the regression along the motion looks at: samples of recordings, lines of a residual."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from dart_model.effects import Motion
from rig.diagnosis.notes import find_friction_n
from rig.diagnosis.problem.build import build, part_of, with_tones
from rig.diagnosis.problem.problem import first_starts, nominal, nominal_model
from rig.diagnosis.problem.track import largest_stride, pieces
from rig.diagnosis.search.fit import fit
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
    thinned = largest_stride([motion_of(t_s, z, w)])
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


@pytest.mark.slow
@pytest.mark.parametrize("bench", [little_bench, little_dyno])
def test_parts_that_are_kept_back_are_not_looked_at(bench):
    recording = bench.run(bench.Nothing(), duration_s=60.0)
    problem = build(bench.model(), [recording], 32, 5)
    model = nominal_model(problem, first_starts(problem, nominal(problem)))
    segments = problem.segments(model, 500, 1)
    assert 0 < len(segments) < 8
    assert all(len(segment.target) for segment in segments)


def test_a_slow_line_is_taken_out_and_is_no_tone():
    problem = build(little_dyno.model(), [little_dyno.run(little_dyno.Nothing())], 32, None)
    forces = problem.residual_forces(0, nominal_model(problem, (np.zeros(0),)))
    t_s = forces.track.t_s
    slow_hz, fast_hz = 3.0 / t_s[-1], 31.0 / t_s[-1]
    force_n = np.array(
        [50.0 * np.sin(2 * np.pi * slow_hz * t_s) + np.cos(2 * np.pi * fast_hz * t_s)]
    )
    (motion,) = with_tones(problem, [forces._replace(force_n=force_n)])
    assert all(hz >= 5.0 / t_s[-1] for hz, _ in motion.tones)
    assert motion.tones[0] == pytest.approx((fast_hz, 0.5 * np.pi), rel=0.02)


def cut_and_whole(bench):
    """A problem, its pieces, and the residual of the model without effects over all of it."""
    problem = build(bench.model(), [bench.run(bench.Nothing(), duration_s=24.0)], 32, None)
    nodes = problem.fit_nodes(0).size
    part = part_of(problem, nodes // 4)
    model = nominal_model(problem, first_starts(problem, nominal(problem)))
    whole = np.full(nodes, np.nan)
    whole[problem.fit_nodes(0)] = problem.residual(0, model)
    cuts = pieces(nodes, nodes, nodes // 4, 1)
    there = [w[np.isfinite(w)] for w in (whole[cut] for cut in cuts)]
    return part, model, there


def test_along_a_given_motion_a_piece_misses_what_the_whole_misses_there():
    part, _, whole = cut_and_whole(little_dyno)
    assert part.recordings == len(whole) == 8
    for k, there in enumerate(whole):
        own = part.residual(k, nominal_model(part, (np.zeros(0),) * 8))
        assert own == pytest.approx(there, rel=1e-9)
        assert len(part.blocks(k)) == len(there)


def test_the_first_piece_of_a_free_run_begins_as_the_recording_does():
    part, model, whole = cut_and_whole(little_bench)
    assert part.recordings == len(whole) == 8
    assert part.residual(0, model) == pytest.approx(whole[0], rel=1e-9)


def test_pieces_of_a_free_run_are_where_they_were_in_the_recording():
    part, model, _ = cut_and_whole(little_bench)
    first = nominal_model(part, first_starts(part, model.candidate))
    found = fit(part, first, model.parts.linear > 0.0, effects=False)
    assert found.mean_square == pytest.approx(1.0, abs=0.2)


def test_no_piece_is_searched_that_is_kept_back():
    problem = build(little_bench.model(), [little_bench.run(little_bench.Nothing())], 32, 5)
    part = part_of(problem, problem.fit_nodes(0).size // 8)
    shares = [part.fit_nodes(k).mean() for k in range(part.recordings)]
    assert min(shares) > 0.5
    assert len(shares) < 8


def test_short_recordings_are_searched_whole():
    problem = build(little_bench.model(), [little_bench.run(little_bench.Nothing())], 32, None)
    assert part_of(problem, problem.fit_nodes(0).size) is problem
    assert part_of(problem, problem.fit_nodes(0).size // 2 + 1) is problem


def test_a_damper_whose_knee_is_below_all_speeds_is_dry_friction():
    velocity = 0.3 * np.sin(np.linspace(0.0, 40.0, 4001))

    def digressive(knee_m_per_s):
        return -28.0 * np.tanh(velocity / knee_m_per_s)

    assert find_friction_n(digressive(0.003), velocity) == pytest.approx(28.0, rel=0.02)
    assert find_friction_n(digressive(0.3), velocity) is None
    assert find_friction_n(-900.0 * velocity, velocity) is None
    # Friction drives nothing.
    assert find_friction_n(-digressive(0.003), velocity) is None
    assert find_friction_n(np.zeros(4), np.zeros(4)) is None
