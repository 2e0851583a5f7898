"""Zero, direction and tare in a configuration: a sensor that counts in its own way."""

import re

import pytest
import yaml

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check
from tests.faults.trial import Trial

RANGE = "[-1.048576|1.048574]"
AS_IS = f"HEIGHT : 12|20@1- (2E-006,0) {RANGE}"
DRAW_WIRE = "HEIGHT : 12|20@1- (-2E-006,0.25) [-0.798574|1.298576]"
"""The same counts of a sensor that is pulled out while the strut gets shorter."""

HEIGHT = {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT"}
FORCE = {"message": "BENCH_MEASUREMENT", "signal": "APPLIED_FORCE"}
TEMPERATURE = {"message": "BENCH_AUXILIARY", "signal": "TEMPERATURE"}
LOAD_CELL = {"message": "BENCH_AUXILIARY", "signal": "LOAD_CELL_FORCE"}
ZERO = {"zero": {"reads": 0.25, "at_m": 0.0}, "reversed": True}


def config(folder, dbc_of_sensor=DRAW_WIRE, **signals):
    text = DEFAULT_DATABASE.read_text()
    assert text.count(AS_IS) == 2  # of two benches
    (folder / "my.dbc").write_text(text.replace(AS_IS, dbc_of_sensor))
    data = yaml.safe_load((CONFIGS / "reference.yaml").read_text()) | {"dbc": "my.dbc"}
    for key, given in signals.items():
        data["signals"][key] = given
    path = folder / "my.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def trial_of(path):
    """A bench of the shipped DBC, and a bridge of a configuration."""
    trial = Trial()
    trial.bridge = build_bridge(load_plan(path))
    trial.state = trial.bridge.init(0)
    return trial


def test_behind_a_reversed_sensor_with_a_zero_all_is_as_without(tmp_path):
    usual = Trial().run(300)
    path = config(tmp_path, height={"strut": {**HEIGHT, **ZERO}})
    found = trial_of(path).run(300)
    for tick, other in zip(found, usual, strict=True):
        assert tick.result.output == other.result.output
        assert tick.result.step_input.samples == other.result.step_input.samples


def test_a_tare_is_no_force(tmp_path):
    path = config(tmp_path, AS_IS, applied_force={**FORCE, "tare_n": 12.5, "reversed": True})
    found, usual = trial_of(path).run(20), Trial().run(20)
    for tick, other in zip(found, usual, strict=True):
        mine, its = (
            [item.value for item in it.result.step_input.samples if item.channel == 1]
            for it in (tick, other)
        )
        assert mine == pytest.approx([12.5 - value for value in its])


def test_the_dbcs_range_is_one_of_lengths(tmp_path):
    """A limit follows from what the sensor can read, as lengths."""
    zero = {"zero": {"reads": 0.1, "at_m": 0.4}}
    found, usual = (
        next(row for row in limits_of_strut(tmp_path, more) if row.value.value == "height_m")
        for more in (zero, {})
    )
    assert (found.low, found.high) == pytest.approx((usual.low + 0.3, usual.high + 0.3))


def limits_of_strut(folder, more):
    return load_plan(config(folder, AS_IS, height={"strut": {**HEIGHT, **more}})).limits.struts[0]


@pytest.mark.parametrize(
    ("given", "dbc", "severity", "text"),
    [
        ({}, AS_IS, Severity.WARNING, "none was set: .* rig zero .*my.yaml --length"),
        (ZERO, DRAW_WIRE, Severity.OK, r"a reading of 250 mm is a length of 0 mm, reversed"),
        (
            {"zero": ZERO["zero"]},
            DRAW_WIRE,
            Severity.WARNING,
            "not known whether the sensor is reversed: expected rig zero .*my.yaml --length",
        ),
        ({}, AS_IS.replace(",0)", ",0.2)"), Severity.OK, "offset in the DBC; rig zero"),
    ],
)
def test_a_height_without_a_zero_is_a_warning(tmp_path, given, dbc, severity, text):
    plan = load_plan(config(tmp_path, dbc, height={"strut": {**HEIGHT, **given}}))
    (found,) = [item for item in check(plan) if item.what == "zero of strut"]
    assert found.severity is severity
    assert re.search(text, found.text)


def test_a_signal_has_one_zero(tmp_path):
    given = {**LOAD_CELL, "tare_n": 3.0}
    other = {**LOAD_CELL, "measures": "force", "noise_std_n": 0.5, "tare_n": 2.0}
    path = config(tmp_path, AS_IS, load_cell_force=given, further={"strut": {"cell": other}})
    data = yaml.safe_load(path.read_text())
    data["observers"] = {
        "strut": {"kind": "kalman", "filter": {"bandwidth_hz": 19, "noise_std_m": 2e-5}}
    }
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(
        InputError,
        match=r"further\.strut\.cell: .* another zero, direction or tare in signals\.load_cell_f",
    ):
        load_plan(path)


@pytest.mark.parametrize(
    ("signals", "expected"),
    [
        (
            {"height": {"strut": {**HEIGHT, "reversed": True}}},
            r"signals\.height\.strut\.reversed: expected zero",
        ),
        (
            {"height": {"strut": {**HEIGHT, "tare_n": 1.0}}},
            r"signals\.height\.strut\.tare_n: height is no force, expected zero",
        ),
        (
            {"applied_force": {**FORCE, "zero": {"reads": 0.0, "at_m": 0.0}}},
            r"signals\.applied_force\.zero: applied_force is no length, expected tare_n",
        ),
        (
            {"temperature": {**TEMPERATURE, "reversed": True}},
            r"signals\.temperature\.reversed: temperature has no direction, expected none",
        ),
        (
            {"temperature": {**TEMPERATURE, "tare_n": 0}},
            r"signals\.temperature\.tare_n: temperature is no force, expected none",
        ),
        (
            {"height": {"strut": {**HEIGHT, "zero": {"reads": 0.1}}}},
            r"signals\.height\.strut\.zero\.at_m: is missing",
        ),
    ],
)
def test_what_has_no_such_zero_is_one_line(tmp_path, signals, expected):
    with pytest.raises(InputError, match=expected) as caught:
        load_plan(config(tmp_path, **signals))
    assert "\n" not in str(caught.value)
