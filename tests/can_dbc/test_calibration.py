"""Zero, direction and tare: what a codec gives of a sensor that is mounted in its own way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.calibration import Calibration, calibrate
from can_dbc.codec import compile_decoder, compile_encoder, decode_log, si_range, si_step
from can_dbc.database import load_database
from can_dbc.errors import DatabaseError
from can_dbc.units import Dimension

SIGNALS = """BO_ 256 SENSOR: 8 BENCH
 SG_ TRAVEL : 7|16@0- (0.01,125) [-100|200] "mm" RIG
 SG_ OPEN : 24|8@1+ (1,-20) [0|0] "cm" RIG
 SG_ FLOATING : 32|32@1- (1,0) [-3|5] "m" RIG
"""
NAMES = ("TRAVEL", "OPEN", "FLOATING")
CALIBRATIONS = st.builds(Calibration, st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.booleans())


@pytest.fixture(scope="module")
def sensor(write_dbc):
    return load_database(write_dbc(SIGNALS)).message("SENSOR")


@given(
    name=st.sampled_from(NAMES),
    calibration=CALIBRATIONS,
    payload=st.binary(min_size=4, max_size=4),
    number=st.floats(-3.0, 5.0, width=32),
)
def test_a_frame_gives_what_is_measured(sensor, name, calibration, payload, number):
    payload += np.float32(number).tobytes()
    calibrated = calibrate(sensor, name, Dimension.LENGTH, calibration)
    (reading,) = compile_decoder(sensor, [name], [Dimension.LENGTH])(payload)
    (measured,) = compile_decoder(calibrated, [name], [Dimension.LENGTH])(payload)
    sign = -1.0 if calibration.is_reversed else 1.0
    expected = calibration.at + sign * (reading - calibration.reads)
    assert measured == pytest.approx(expected, rel=1e-12, abs=1e-12)
    data = np.frombuffer(payload, np.uint8).reshape(1, 8)
    logged = decode_log(calibrated, [name], [Dimension.LENGTH], data)[name][0]
    assert logged == pytest.approx(expected, rel=1e-12, abs=1e-12)


@given(name=st.sampled_from(NAMES), calibration=CALIBRATIONS)
def test_range_and_step_are_those_of_what_is_measured(sensor, name, calibration):
    calibrated = calibrate(sensor, name, Dimension.LENGTH, calibration)
    ends = [calibration.apply(end) for end in si_range(sensor, name, Dimension.LENGTH)]
    found = si_range(calibrated, name, Dimension.LENGTH)
    step = si_step(sensor, name, Dimension.LENGTH)
    assert found == pytest.approx((min(ends), max(ends)), rel=1e-9, abs=1e-9)
    assert si_step(calibrated, name, Dimension.LENGTH) == pytest.approx(step, rel=1e-12)


@given(calibration=CALIBRATIONS, share=st.floats(0.0, 1.0))
def test_what_is_encoded_comes_back(sensor, calibration, share):
    calibrated = calibrate(sensor, "TRAVEL", Dimension.LENGTH, calibration)
    low, high = si_range(calibrated, "TRAVEL", Dimension.LENGTH)
    value = low + share * (high - low)
    payload, is_held = compile_encoder(calibrated, ["TRAVEL"], [Dimension.LENGTH])([value])
    (back,) = compile_decoder(calibrated, ["TRAVEL"], [Dimension.LENGTH])(payload)
    assert not is_held
    assert abs(back - value) <= 0.5e-5 + 1e-12


def test_the_other_signals_stay_what_they_are(sensor):
    calibrated = calibrate(
        sensor, "TRAVEL", Dimension.LENGTH, Calibration(0.1, 0.4, is_reversed=True)
    )
    for name in NAMES[1:]:
        assert calibrated.signal(name) is sensor.signal(name)


def test_a_signal_of_another_dimension_is_refused(sensor):
    with pytest.raises(DatabaseError, match="TRAVEL"):
        calibrate(sensor, "TRAVEL", Dimension.FORCE, Calibration(1.0))
