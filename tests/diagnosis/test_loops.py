"""A strut in a mechanism with a closed loop, diagnosed from its heights as one on a guide is."""

import json

import numpy as np
import pytest

from dart_model.spec import parse_model
from rig.diagnosis.diagnose import diagnose
from tests.dart_model.mechanisms import (
    CONTACT_M,
    double_wishbone,
    exact_angles,
    macpherson,
    with_stop,
)
from tests.diagnosis.mechanisms import lines_n, recording

TONES_HZ = (0.7, 1.3, 2.1, 3.4, 5.2, 7.9)


def recorded(make, seed):
    """A run of ten seconds at 500 Hz, with a stop that the model does not have."""
    bench = with_stop(make)
    load_n = lines_n(900.0, TONES_HZ, shift=3.7 * seed)
    t_s = np.arange(0.0, 10.0, 2e-3)
    angles = exact_angles(bench, t_s, load_n, rtol=1e-8)
    lengths_m = np.array([[bench.strut_m(angle)] for angle in angles])
    return recording(f"run{seed}", t_s, lengths_m, load_n, seed)


@pytest.mark.slow
@pytest.mark.parametrize("make", [double_wishbone, macpherson])
def test_a_bump_stop_is_found_from_the_heights(make):
    spec = parse_model(json.dumps(make().content), "a test")
    found = diagnose(spec, [recorded(make, 1)], [recorded(make, 2)]).diagnosis
    assert found.verdict == "explained"
    [stop] = found.effects
    assert stop.family == "stop"
    contact = stop.parameters["contact_height_m"]
    assert contact.value == pytest.approx(CONTACT_M[make], abs=5e-4)
    after, floor = found.held_out.height_rmse_m.after, found.noise_floor.height_rmse_m
    assert after < 1.2 * floor
