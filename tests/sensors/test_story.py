"""From a bus without a DBC to a diagnosis, over a bus inside this process."""

import threading

import pytest

from rig.core.contract import Mode
from tests.sensors.dyno import FRICTION_N, serve
from tests.sensors.story import Line, configured, diagnosed, queue, with_faults


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
    assert found["verdict"] == "explained"
    (effect,) = found["effects"]
    assert effect["family"] == "friction"
    friction = effect["parameters"]["coulomb_force_n"]
    assert friction["value"] == pytest.approx(FRICTION_N, rel=0.05)


@pytest.mark.long
def test_faults_of_a_sensor(line, tmp_path):
    config = configured(line, tmp_path)
    found = with_faults(line, config, tmp_path)
    for order, wrong in (("emergency", "emergency 0x8130"), ("silent", "no heartbeat")):
        assert found[order].wrong == [{"NODE_5": wrong}]
        assert found[order].modes >= {Mode.RUNNING, Mode.HOLD}
        assert found[order].ended.state.counts.from_faulty_device > 50
    assert found["short"].ended.state.counts.wrong_length > 50
    assert found["short"].ended.state.core.mode is Mode.HOLD
