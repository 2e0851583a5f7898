"""A car on four posts: eight heights, seven coordinates, and friction in one corner."""

from dataclasses import replace

import numpy as np
import pytest

from dart_model.spec import MODELS, load_model
from rig.channels.measured_quantities import MOTION
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.delay_estimate import estimate_delays
from rig.diagnosis.problem.mechanism import solve_nearest
from rig.diagnosis.problem.on_dart import dart_heights
from rig.diagnosis.problem.problem import first_starts, nominal, nominal_model
from rig.plan.config import CONFIGS
from rig.recordings.recording import RecordedInput, Recording
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import UndeclaredEffect
from rig.simulated_bench.trajectory import simulate

NOISE_M = 1e-5
CORNERS = ("fl", "fr", "rl", "rr")


def recording(seed, *effects, duration_s=6.0):
    """Eight heights and four posts at 250 Hz, each with noise."""
    bench = load_bench_config(CONFIGS / "four_post_bench.yaml")
    motions = []
    for k, motion in enumerate(bench.prescribed_motion):
        parts = tuple(it.model_copy(update={"seed": 10 * seed + k}) for it in motion.components)
        motions.append(motion.model_copy(update={"components": parts}))
    update = {"undeclared_effects": effects, "prescribed_motion": tuple(motions)}
    course = simulate(bench.model_copy(update=update), round(duration_s * 1e9), 4_000_000)
    rng = np.random.default_rng(seed)
    measured = course.height_m + NOISE_M * rng.standard_normal(course.height_m.shape)
    posts = {
        f"post_{corner}": RecordedInput(MOTION, measured[:, k], None)
        for k, corner in enumerate(CORNERS)
    }
    return Recording(f"run{seed}", course.t_ns * 1e-9, measured[:, 4:], posts)


@pytest.mark.long
def test_friction_in_one_corner_is_found_there():
    friction = UndeclaredEffect.model_validate(
        {"name": "friction", "strut": "suspension_rl", "parameters": {"coulomb_force_n": 90.0}}
    )
    model = load_model(MODELS / "four_post.yaml")
    found = diagnose(model, [recording(1, friction)], [recording(2, friction)]).diagnosis
    [missing] = found.effects
    assert (missing.family, missing.strut) == ("friction", "suspension_rl")
    assert missing.parameters["coulomb_force_n"].value == pytest.approx(90.0, rel=0.02)
    assert found.held_out.height_rmse_m.after < 1.1 * found.noise_floor.height_rmse_m


def late(run, post, samples):
    """A recording of which one post is late by some samples."""
    item = run.inputs[post]
    held = np.concatenate([np.full(samples, item.values[0]), item.values[:-samples]])
    return replace(run, inputs=run.inputs | {post: replace(item, values=held)})


@pytest.mark.slow
def test_a_late_post_moves_the_model_as_it_moves_dart():
    problem = build_without_delays(
        load_model(MODELS / "four_post.yaml"), [recording(1, duration_s=2.0)], 8, None
    )
    model = nominal_model(problem, first_starts(problem, nominal(problem)))
    as_measured = problem.simulate(problem.runs[0], model, model.parts.starts[0]).heights_m
    run = problem.runs[0].before_delays(np.array([0.0, 0.0, 3e-3, 0.0]))
    moved = problem.simulate(run, model, model.parts.starts[0]).heights_m
    by_dart = dart_heights(problem, run, model, model.parts.starts[0], moved, 1e-5)
    # The mechanism is linear about the measured motion, from which this one is millimetres off.
    change_m = np.abs(moved - as_measured).max()
    assert change_m > 2e-3
    np.testing.assert_allclose(moved, by_dart, rtol=0.0, atol=0.01 * change_m)


@pytest.mark.slow
def test_a_late_post_is_seen_beside_a_rough_model():
    """The forces of eight struts are known but for a part in balance with itself."""
    spec = load_model(MODELS / "four_post.yaml")
    struts = tuple(
        strut.model_copy(update={"damping_n_s_per_m": 0.8 * strut.damping_n_s_per_m})
        for strut in spec.struts
    )
    run = late(recording(1), "post_rl", 1)
    found = estimate_delays(
        build_without_delays(spec.model_copy(update={"struts": struts}), [run], 8, None)
    )
    assert len(found) == 11
    for channel, (delay_s, std_s) in found.items():
        expected_s = 4e-3 if channel == "motion_m:post_rl" else 0.0
        assert std_s < 3e-4, channel
        # Within what the search that follows looks through.
        assert delay_s == pytest.approx(expected_s, abs=1e-3), channel


def test_forces_in_balance_are_no_part_of_the_smallest_ones():
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((5, 8, 7))
    forces = rng.standard_normal((5, 8))
    transposed = np.swapaxes(rows, 1, 2)
    found = solve_nearest(transposed, (transposed @ forces[..., None])[..., 0])
    # They do the same, and are across what does nothing.
    assert (transposed @ (found - forces)[..., None])[..., 0] == pytest.approx(0.0, abs=1e-12)
    assert np.sum(found * (forces - found), axis=1) == pytest.approx(0.0, abs=1e-12)
