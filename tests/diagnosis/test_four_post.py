"""A car on four posts: eight heights, seven coordinates, and friction in one corner."""

import numpy as np
import pytest

from dart_model.spec import MODELS, load_model
from rig.channels.measured_quantities import MOTION
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.problem.mechanism import solve_nearest
from rig.plan.config import CONFIGS
from rig.recordings.recording import RecordedInput, Recording
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import UndeclaredEffect
from rig.simulated_bench.trajectory import simulate

NOISE_M = 1e-5
CORNERS = ("fl", "fr", "rl", "rr")


def recording(seed, *effects):
    """Eight heights and four posts at 250 Hz, each with noise."""
    bench = load_bench_config(CONFIGS / "four_post_bench.yaml")
    motions = []
    for k, motion in enumerate(bench.prescribed_motion):
        parts = tuple(it.model_copy(update={"seed": 10 * seed + k}) for it in motion.components)
        motions.append(motion.model_copy(update={"components": parts}))
    update = {"undeclared_effects": effects, "prescribed_motion": tuple(motions)}
    course = simulate(bench.model_copy(update=update), 6_000_000_000, 4_000_000)
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


def test_forces_in_balance_are_no_part_of_the_smallest_ones():
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((5, 8, 7))
    forces = rng.standard_normal((5, 8))
    transposed = np.swapaxes(rows, 1, 2)
    found = solve_nearest(transposed, (transposed @ forces[..., None])[..., 0])
    # They do the same, and are across what does nothing.
    assert (transposed @ (found - forces)[..., None])[..., 0] == pytest.approx(0.0, abs=1e-12)
    assert np.sum(found * (forces - found), axis=1) == pytest.approx(0.0, abs=1e-12)
