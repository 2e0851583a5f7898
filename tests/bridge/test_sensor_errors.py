"""Errors of virtual sensors: what heights determine, a moved base does, and observers know."""

import numpy as np
import pytest

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.sensor_errors import find_errors, make_gains
from rig.bridge.tracked_motion import error_gains
from rig.closed_loop.sensor_response import SensorResponse, respond_to_motion
from rig.observers.protocol import EstimateErrors

SENSORS = {
    "platform": VirtualSensor(position_of="platform"),
    "wheel": VirtualSensor(position_of="wheel"),
    "body": VirtualSensor(position_of="body"),
    "speed": VirtualSensor(velocity_of="body"),
}


@pytest.fixture(scope="module")
def plant():
    return DartPlant(load_model(MODELS / "quarter_car_road.yaml"))


def response_of(plant, struts):
    reader, inputs = plant.virtual_sensors(SENSORS), (0.0, 0.0, 0.0)
    return respond_to_motion(plant, reader, plant.init([0.29, 0.35]), inputs, struts, (0,))


def test_positions_are_sums_of_heights_above_the_road(plant):
    found = response_of(plant, [0, 1])
    assert found.is_determined.all()
    expected = [[0, 0, 0, 0], [1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 1]]
    assert found.by_heights == pytest.approx(np.array(expected), abs=1e-8)


def test_with_its_heights_kept_a_body_moves_as_the_road_does(plant):
    found = response_of(plant, [0, 1])
    alone, kept = found.by_inputs[0], found.with_inputs[0]
    assert alone == pytest.approx(np.array([[1, 0], [0, 0], [0, 0], [0, 0]]), abs=1e-8)
    assert kept == pytest.approx(np.array([[1, 0], [1, 0], [1, 0], [0, 1]]), abs=1e-8)


def test_one_height_of_two_does_not_determine_the_body(plant):
    assert response_of(plant, [0]).is_determined.tolist() == [True, True, False, False]
    assert response_of(plant, [1]).is_determined.tolist() == [True, False, False, False]


def gains_of(plant, struts, motions=()):
    none = np.zeros((2 * len(motions), 4))
    return make_gains([True] * 4, np.zeros((4, 2)), response_of(plant, struts), motions, none)


def errors_of(mean, covariance):
    return EstimateErrors(mean, np.array(covariance).ravel())


def test_what_heights_do_not_determine_has_no_deviation_and_no_correction(plant):
    known = errors_of([1e-3, 0.1], np.diag([0.0, 0.0, 4e-12, 9e-6]))
    corrections, stds = find_errors(gains_of(plant, [0]), known, ())
    assert corrections == pytest.approx([0.0, 1e-3, 0.0, 0.0], abs=1e-9)
    assert stds == pytest.approx([0.0, 2e-6, np.nan, np.nan], abs=1e-9, nan_ok=True)


def test_deviations_are_those_of_forces_or_of_the_motion():
    """Two sensors: an acceleration by two forces, and a height of two that err together."""
    response = SensorResponse(
        np.array([[9.0, 9.0, 9.0, 9.0], [1.0, 1.0, 0.0, 0.0]]),
        np.zeros((1, 2, 2)),
        np.zeros((1, 2, 2)),
        np.array([True, True]),
    )
    by_force = [[0.5, -0.5], [9.0, 9.0]]
    road = error_gains(0.005, 1e-3, has_acceleration=False)
    noise_n2 = np.array([[0.0, 0.0, 0.0, 4.0], [0.0] * 4])
    gains = make_gains([False, True], by_force, response, [road], noise_n2)
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = [[4.0, 4.0], [4.0, 20.0]]
    covariance[2:4, 2:4] = [[1e-10, -1e-10], [-1e-10, 5e-10]]
    known = errors_of([1e-5, 3e-5, 0.0, 0.0], covariance)
    corrections, stds = find_errors(gains, known, ())
    assert corrections == pytest.approx([0.0, 4e-5])
    assert stds == pytest.approx([2.0, 2e-5])
    _, stds = find_errors(gains, known, (5.0, 0.0))
    assert stds == pytest.approx([3.0, 2e-5])


def test_noise_and_lag_of_the_road_are_in_what_moves_with_it(plant):
    """Noise of the road is that of the platform alone; a lag of it that of the whole car."""
    road = error_gains(0.005, 1e-3, has_acceleration=False)
    gains = gains_of(plant, [0, 1], [road])
    nothing = errors_of(np.zeros(4), np.zeros((6, 6)))
    _, noisy = find_errors(gains, nothing, (1e-10, 0.0))
    assert noisy == pytest.approx([np.sqrt(1e-10 * road.noise[0, 0]), 0.0, 0.0, 0.0], abs=1e-10)
    _, late = find_errors(gains, nothing, (0.0, 1e-10))
    lag_m = 1e-5 * abs(road.lag[0])
    assert late == pytest.approx([lag_m, lag_m, lag_m, 0.0], rel=1e-6, abs=1e-10)
