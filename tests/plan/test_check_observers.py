"""What the check says of observers: their filters, and what heights cannot tell."""

import pytest

from can_dbc.errors import InputError
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check

FILTER = "{kind: kalman, filter: {bandwidth_hz: %s, noise_std_m: %s}}"


def findings(folder, bandwidth_hz="20", noise_std_m="2.0e-5", name="reference", more=""):
    text = (CONFIGS / f"{name}.yaml").read_text()
    observer = FILTER % (bandwidth_hz, noise_std_m)
    head = text[: text.index("observers:")]
    (folder / "rig.yaml").write_text(head + f"observers: {{strut: {observer}}}\n" + more)
    return {item.what: item for item in check(load_plan(folder / "rig.yaml"))}


def test_a_filter_within_its_rate_is_fine(tmp_path):
    found = findings(tmp_path)
    assert found["filter of strut"].severity is Severity.OK
    assert found["poles"].severity is Severity.OK
    assert found["observability"].severity is Severity.OK


def test_a_filter_that_follows_single_measurements_is_warned_of(tmp_path):
    found = findings(tmp_path, bandwidth_hz="400")
    assert found["filter of strut"].severity is Severity.WARNING
    assert "follows single measurements" in found["filter of strut"].text


@pytest.mark.parametrize("bandwidth_hz", ["0.01", "300"])
def test_no_filter_within_its_bounds_breaks_the_loop(tmp_path, bandwidth_hz):
    assert findings(tmp_path, bandwidth_hz=bandwidth_hz)["poles"].severity is not Severity.ERROR


@pytest.mark.parametrize(
    ("bandwidth_hz", "noise_std_m", "says"),
    [
        ("1.0e-9", "1.0e-5", "filter.bandwidth_hz: 1e-09: expected "),
        ("1.0e+6", "1.0e-5", "filter.bandwidth_hz: 1000000.0: expected "),
        ("20", "1.0e-300", "filter.noise_std_m: 1e-300: expected "),
        ("20", "1.0e+300", "filter.noise_std_m: 1e+300: expected "),
    ],
)
def test_senseless_filters_are_refused_in_a_line(tmp_path, bandwidth_hz, noise_std_m, says):
    with pytest.raises(InputError) as refused:
        findings(tmp_path, bandwidth_hz, noise_std_m)
    assert says in str(refused.value)


def test_what_heights_cannot_tell_stands_in_words(tmp_path):
    found = findings(tmp_path)["separability"].text
    assert "the spring's force of strut and the damper's" in found
    assert "a preload of strut and an offset of its height sensor" in found


def quarter(folder, observers, heights):
    text = (CONFIGS / "quarter_car.yaml").read_text()
    head = text[: text.index("signals:")] + f"signals: {{height: {heights}}}\n"
    (folder / "rig.yaml").write_text(head + f"observers: {observers}\n")
    return load_plan(folder / "rig.yaml")


TYRE = "tyre: {message: BENCH_MEASUREMENT, signal: HEIGHT}"
SUSPENSION = "suspension: {message: BENCH_MEASUREMENT_2, signal: HEIGHT}"


def test_without_a_height_the_check_says_what_is_lost():
    found = {item.what: item.text for item in check(load_plan(CONFIGS / "quarter_car.yaml"))}
    assert "the residual force of tyre" in found["without the height of tyre"]
    assert "tyre, suspension" in found["observability"]


def test_a_strut_that_nobody_measures_has_to_be_declared(tmp_path):
    with pytest.raises(InputError, match=r"signals.height.tyre: is missing.*kind: none"):
        quarter(tmp_path, "{suspension: {kind: pi}}", f"{{{SUSPENSION}}}")
    # Whether its height is logged makes no difference to what is observed.
    for heights in (f"{{{SUSPENSION}}}", f"{{{TYRE}, {SUSPENSION}}}"):
        ready = quarter(tmp_path, "{tyre: {kind: none}}", heights)
        found = {item.what: item for item in check(ready)}
        assert found["observability"].text == "the residual force of suspension is observable"


def test_a_height_that_is_old_goes_stale_later(tmp_path):
    late = "signals: {height: {message: BENCH_MEASUREMENT, signal: HEIGHT, delay_s: 0.02}}\n"
    text = (CONFIGS / "reference.yaml").read_text()
    head = text[: text.index("signals:")]
    (tmp_path / "rig.yaml").write_text(head + late)
    found = {item.what: item for item in check(load_plan(tmp_path / "rig.yaml"))}
    assert found["supervision.stale_after_s"].severity is Severity.ERROR
    assert "20 ms old when it arrives" in found["supervision.stale_after_s"].text
