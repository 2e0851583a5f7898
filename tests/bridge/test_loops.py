"""A strut in a mechanism with a closed loop, observed as one on a guide is."""

import json

import numpy as np
import pytest

from dart_model.plant import DartPlant
from dart_model.spec import parse_model
from tests.bridge.test_larger_systems import RATE_HZ, error, follow, noisy
from tests.dart_model.mechanisms import (
    CONTACT_M,
    STOP_N_PER_M,
    double_wishbone,
    exact_angles,
    macpherson,
    with_stop,
)
from tests.diagnosis.mechanisms import lines_n

LOAD_N = lines_n(900.0, (0.7, 1.3, 2.1, 3.4, 5.2, 7.9))


@pytest.mark.slow
@pytest.mark.parametrize("make", [double_wishbone, macpherson])
def test_its_force_is_estimated_with_and_without_the_stop_of_its_bench(make):
    bench = with_stop(make)
    t_s = np.arange(0.0, 4.0, 1.0 / RATE_HZ)
    angles = exact_angles(bench, t_s, LOAD_N, rtol=1e-8)
    lengths_m = np.array([[bench.strut_m(angle)] for angle in angles])
    rates = np.gradient(lengths_m[:, 0], t_s)
    strut = bench.content["struts"][0]
    truth = -strut["stiffness_n_per_m"] * (lengths_m[:, 0] - strut["free_length_m"])
    truth -= strut["damping_n_s_per_m"] * rates
    truth += [bench.undeclared_n(length, 0.0) for length in lengths_m[:, 0]]
    applied_n = np.array([LOAD_N(t) for t in t_s])

    def missed(effects):
        content = bench.content | {"struts": [strut | {"effects": effects}]}
        plant = DartPlant(parse_model(json.dumps(content), "a test"))
        return error(follow(plant, noisy(lengths_m), applied_n), truth[:, None])[0]

    stop = {
        "contact_height_m": CONTACT_M[make],
        "stiffness_n_per_m": STOP_N_PER_M,
        "damping_n_s_per_m": 0.0,
    }
    assert missed([]) < 0.1
    assert missed([{"name": "bump_stop", "parameters": stop}]) < 0.02
