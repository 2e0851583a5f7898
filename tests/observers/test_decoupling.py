"""Struts that move each other: their observers' forces are decoupled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.closed_loop.decoupling import combine, combine_stds, decouple
from rig.closed_loop.loop import Loop, SampleTiming
from rig.closed_loop.strut_response import mobility_matrix
from rig.observers import OBSERVERS

REST_M = (0.29, 0.35)
FORCES = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=2)


def observer(kind="kalman", bandwidth_hz=25.0):
    given = {
        "kalman": {"kind": "kalman", "filter": {"bandwidth_hz": bandwidth_hz, "noise_std_m": 5e-6}},
        "pi": {},
        "none": {"kind": "none"},
    }[kind]
    return TypeAdapter(OBSERVERS[kind]).validate_python(given)


@pytest.fixture(scope="module")
def plant():
    return DartPlant(load_model(MODELS / "quarter_car.yaml"))


def test_mobilities_are_those_of_the_masses(plant):
    wheel, body = 3.0, 15.0
    expected = [[1 / wheel, -1 / wheel], [-1 / wheel, 1 / wheel + 1 / body]]
    assert mobility_matrix(plant, REST_M) == pytest.approx(np.array(expected), rel=1e-9)


@given(asked=FORCES, errors=FORCES)
def test_each_height_has_the_acceleration_that_its_observer_expects(plant, asked, errors):
    mobility = mobility_matrix(plant, REST_M)
    matrix = decouple(plant, [observer(), observer()], REST_M)
    forces = np.array(combine(matrix, asked, errors))
    # Virtual forces and the laws' errors act together; each observer knows its own part alone.
    expected = np.diag(mobility) * (np.array(asked) + np.array(errors))
    assert mobility @ (forces + errors) == pytest.approx(expected, abs=1e-6)


def test_deviations_of_independent_observers_add_up_by_their_squares(plant):
    matrix = decouple(plant, [observer(), observer()], REST_M)
    rng = np.random.default_rng(2)
    draws = rng.standard_normal((200_000, 2)) * [3.0, 5.0]
    combined = np.array(matrix) @ draws.T
    assert combine_stds(matrix, (3.0, 5.0)) == pytest.approx(combined.std(axis=1), rel=0.01)


@pytest.mark.parametrize("kinds", [("pi", "pi"), ("pi", "kalman"), ("kalman", "none")])
def test_other_observers_forces_stay_as_they_are(plant, kinds):
    matrix = decouple(plant, [observer(kind) for kind in kinds], REST_M)
    assert matrix == ()
    assert combine(matrix, [1.0, 2.0], [0.3, 0.0]) == [1.0, 2.0]
    assert combine_stds(matrix, [1.0, 2.0]) == [1.0, 2.0]


def test_a_strut_alone_is_not_decoupled():
    alone = DartPlant(load_model(MODELS / "reference.yaml"))
    assert decouple(alone, [observer()], [0.4]) == ()


@pytest.mark.parametrize("bandwidth_hz", [25.0, 50.0, 100.0])
def test_noise_aware_observers_of_a_quarter_car_are_stable(plant, bandwidth_hz, monkeypatch):
    observers = [observer(bandwidth_hz=bandwidth_hz)] * 2
    timing = SampleTiming(1_000_000)

    def fastest_growth():
        loop = Loop(plant, observers, REST_M, timing)
        return np.abs(np.linalg.eigvals(loop.linear().a)).max()

    assert fastest_growth() < 0.99
    monkeypatch.setattr("rig.closed_loop.loop.decouple", lambda *_: ())
    assert fastest_growth() > 1.01
