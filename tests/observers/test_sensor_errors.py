"""Virtual sensors against benches with equations of their own, without and with virtual forces."""

import math

import pytest

from tests.diagnosis.mechanisms import GRAVITY
from tests.observers.sensor_errors import ON_A_ROAD, ON_ARM, ON_POSTS, PivotArm, rows

SENSORS = [
    ("quarter car on a road", "load of tyre"),
    ("quarter car on a road", "acceleration of the seat"),
    *(("quarter car on a road", it) for it in ON_A_ROAD),
    *(("car on four posts", f"load of tyre {corner}") for corner in ("fl", "fr", "rl", "rr")),
    ("car on four posts", "acceleration of the seat"),
    *(("car on four posts", it) for it in ON_POSTS),
    *(("trailing arm", it) for it in ON_ARM),
]


@pytest.mark.slow
@pytest.mark.parametrize(("bench", "sensor"), SENSORS)
def test_virtual_forces_take_four_fifths_of_the_errors(bench, sensor):
    (found,) = (it for it in rows(6.0, 2) if (it.bench, it.sensor) == (bench, sensor))
    assert found.observed < found.alone / 5.0
    assert found.within > 0.92
    # Of a motion it may be wider than the error: noise hides a smaller one.
    assert found.within < 0.99 or sensor in (*ON_A_ROAD, *ON_POSTS, *ON_ARM)


def test_the_arms_own_reaction_is_that_of_statics_at_rest():
    """Pivot and strut carry the weight, and moments about the pivot vanish."""
    arm = PivotArm()
    arm.load_n = lambda _t: 0.0
    _, heights, (_, _, reactions) = arm.motion(0.02, 1000)
    angle = arm._angle_of(float(heights[0, 0]))
    slope = arm.length(angle)[1]
    weight_n = GRAVITY * (arm.arm_kg + arm.hub_kg)
    lever = GRAVITY * (arm.arm_kg * arm.arm_centre_m + arm.hub_kg * arm.hub_m)
    strut_n = lever * math.cos(angle) / slope
    up = arm.hinge_m[2] + arm.attachment_m * math.sin(angle) - arm.foot_m[2]
    assert reactions == pytest.approx(weight_n - strut_n * up / heights[0, 0], abs=1e-3)
