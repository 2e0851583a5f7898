"""From a bus without a DBC to a diagnosis, over a bus inside this process."""

import threading

import pytest

from tests.sensors.dyno import serve
from tests.sensors.story import (
    Line,
    assert_faults_ended,
    assert_friction_was_found,
    configured,
    diagnosed,
    queue,
    with_faults,
)


@pytest.fixture
def line():
    made = Line("virtual", "sensors-story", queue())
    thread = threading.Thread(target=serve, args=made, daemon=True)
    thread.start()
    yield made
    made.orders.put("end")
    thread.join(10.0)


@pytest.mark.long
def test_from_a_scan_to_a_diagnosis(line, tmp_path):
    found = diagnosed(line, tmp_path, 20.0)
    assert_friction_was_found(found)


@pytest.mark.long
def test_faults_of_a_sensor(line, tmp_path):
    config = configured(line, tmp_path)
    found = with_faults(line, config, tmp_path)
    assert_faults_ended(found)
