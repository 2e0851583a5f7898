"""States of one damper against each other and over a dose, and bands of tolerance."""

import json
import math
from functools import cache
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from can_dbc.errors import InputError
from rig.cli.main import app
from rig.dyno.characterise import ForceRecord, characterise_record
from rig.dyno.comparison import (
    compare_dampers,
    list_not_comparable,
    match_in_band,
    trends_over_dose,
)
from rig.dyno.tolerance import evaluate_band, load_tolerance
from tests.dyno.days import usual
from tests.dyno.pairs import study
from tests.dyno.test_characteristics import written

HEADER = "velocity_m_per_s,compression_low_n,compression_high_n,rebound_low_n,rebound_high_n"
RATE_HZ = 200.0
SPEEDS = (0.003, 0.1, 0.3)


def columns(seed, *, gas_n=200.0, friction_n=15.0, damping=1500.0, zero_n=0.0):
    """A slow cycle and two speeds of a linear damper with friction and a column of gas."""
    rng = np.random.default_rng(seed)
    x, v = [], []
    for speed in SPEEDS:
        frequency = speed / (2.0 * math.pi * 0.02)
        cycles = 2.6 if speed < 0.005 else 8.0
        angle = 2.0 * math.pi * frequency * np.arange(round(cycles / frequency * RATE_HZ)) / RATE_HZ
        x.append(0.02 * np.sin(angle))
        v.append(speed * np.cos(angle))
    x_m, rate = np.concatenate(x), np.concatenate(v)
    gas = gas_n * (1.0 - 15.0 * x_m)
    force = zero_n + gas - damping * rate - friction_n * np.sign(rate)
    t_s = np.arange(len(x_m)) / RATE_HZ
    noise = 1e-6 * rng.standard_normal(len(t_s)), 3.0 * rng.standard_normal(len(t_s))
    return t_s, 0.3 + x_m + noise[0], force + noise[1]


@cache
def state(seed, **changed):
    return characterise_record(ForceRecord(f"state{seed}", *columns(seed, **changed)))


@pytest.mark.slow
def test_a_damper_does_not_differ_from_itself():
    """One comparison in twenty may claim anything at all: three of ten come once in a hundred."""
    claims = [
        any(item.differs for item in compare_dampers(state(2 * k), state(2 * k + 1)))
        for k in range(10)
    ]
    assert sum(claims) <= 2


@pytest.mark.parametrize(
    ("changed", "name", "by", "untouched"),
    [
        ({"gas_n": 160.0}, "gas force", -40.0, ("friction", "energy per cycle at 0.3 m/s")),
        ({"friction_n": 25.0}, "friction", 10.0, ("gas force", "gas spring rate")),
        (
            {"damping": 1350.0},
            "compression force at 0.3 m/s",
            -45.0,
            ("gas force", "gas spring rate"),
        ),
    ],
)
def test_what_was_changed_is_found_and_nothing_else(changed, name, by, untouched):
    found = {item.figure: item for item in compare_dampers(state(1), state(2, **changed))}
    item = found[name]
    assert item.differs
    assert item.change.low <= by <= item.change.high
    assert not any(found[other].differs for other in untouched)


def test_a_zero_of_the_load_cell_is_no_difference():
    """All forces are shifted, and the spring rate is not: that is listed, and removed."""
    before, after = state(1), state(2, zero_n=12.0)
    assert not any(item.differs for item in compare_dampers(before, after))
    assert any(
        "all forces are shifted by +1" in text and "zero of the load cell" in text
        for text in list_not_comparable([before, after])
    )


def test_two_dampers_match_in_per_cent_of_a_band(tmp_path):
    (tmp_path / "band.yaml").write_text(BAND)
    band = load_tolerance(tmp_path / "band.yaml")
    found = match_in_band(state(1), state(2, damping=1350.0), band)
    # The band is 30 and 20 N wide at 0.1 m/s, where a tenth of the damping is 15 N, and 50 and 20 N
    # at 0.2 m/s, which lies between two steps; nothing was measured at 0.9 m/s.
    assert {item.velocity_m_per_s for item in found} == {0.1, 0.2}
    by_point = {(item.side, item.velocity_m_per_s): item for item in found}
    share = by_point["compression", 0.1].share
    assert share.low <= -15.0 / 30.0 <= share.high
    share = by_point["rebound", 0.1].share
    assert share.low <= 15.0 / 20.0 <= share.high
    sizes = [abs(item.share.value) for item in found]
    assert sizes == sorted(sizes, reverse=True)


@pytest.mark.slow
def test_other_conditions_are_no_differences_and_hide_none():
    """Temperature, zero, lag and rate differ at random; what was changed is seen all the same."""
    found = study(8, 2, 3)
    assert found["none"].figures > 200
    assert found["none"].called <= 0.01 * found["none"].figures
    assert all(it.seen == it.pairs for change, it in found.items() if change != "none")


@pytest.mark.slow
def test_temperatures_apart_without_a_change_per_kelvin_are_not_comparable():
    records = []
    for seed, begins_k in ((1, 0.0), (2, 10.0)):
        day = usual(begins_k=begins_k, per_kelvin=-0.002, rate_hz=500.0)
        warm_c = day.temperatures(seed)
        record = ForceRecord(f"at {22 + begins_k} °C", *day.record(seed), temperature_c=warm_c)
        records.append(characterise_record(record))
    assert not any(item.differs for item in compare_dampers(*records))
    said = list_not_comparable(records)
    assert sum("+10.0 K from at 22.0 °C" in text for text in said) == len(records[0].steps)


@pytest.mark.slow
def test_over_a_dose():
    pressures = (2.0, 4.0, 6.0, 8.0)
    states = [state(k, gas_n=50.0 * bar) for k, bar in enumerate(pressures)]
    trends = {item.figure: item for item in trends_over_dose(states, pressures)}
    gas = trends["gas force"]
    assert gas.differs
    assert gas.is_straight
    assert gas.slope.low <= 50.0 <= gas.slope.high
    assert not trends["friction"].differs
    squared = [state(k, gas_n=10.0 * bar**2) for k, bar in enumerate(pressures)]
    bent = {item.figure: item for item in trends_over_dose(squared, pressures)}["gas force"]
    assert not bent.is_straight
    with pytest.raises(InputError, match="at least three different ones"):
        trends_over_dose(states, (1.0, 1.0, 1.0, 1.0))


BAND = """
name: master
points:
  - {velocity_m_per_s: 0.1, compression_low_n: 350, compression_high_n: 380, rebound_low_n: 25,
     rebound_high_n: 45}
  - {velocity_m_per_s: 0.2, compression_low_n: 550, compression_high_n: 600, rebound_low_n: 0,
     rebound_high_n: 20}
  - {velocity_m_per_s: 0.9, compression_low_n: 0, compression_high_n: 1, rebound_low_n: 0,
     rebound_high_n: 1}
"""


def judged_by(item, path):
    return evaluate_band(item.steps, load_tolerance(path))


def test_points_pass_fail_or_stay_open(tmp_path):
    (tmp_path / "band.yaml").write_text(BAND)
    found = judged_by(state(1), tmp_path / "band.yaml")
    assert [item.verdict for item in found] == [
        "pass", "pass",  # 365 N and 35 N at 0.1 m/s
        "open", "open",  # at 0.2 m/s, between two steps: anything between their forces
        "not measured", "not measured",
    ]  # fmt: skip
    # A limit at what the damper has is neither kept nor broken.
    tight = BAND.replace("compression_low_n: 350", "compression_low_n: 365.0")
    (tmp_path / "tight.yaml").write_text(tight)
    assert judged_by(state(1), tmp_path / "tight.yaml")[0].verdict == "open"


def test_a_point_between_two_steps_holds_what_a_damper_may_have_there(tmp_path):
    """A digressive damper has more than the straight line between two steps."""
    (tmp_path / "band.yaml").write_text(BAND)
    at_02 = [item for item in judged_by(state(1), tmp_path / "band.yaml") if item.force][2:]
    for item, (low_n, high_n) in zip(at_02, ((365.0, 665.0), (-265.0, 35.0)), strict=True):
        assert item.force.low <= low_n
        assert item.force.high >= high_n
        assert "between steps" in item.words()


def test_a_warm_up_is_judged_by_no_band(tmp_path):
    (tmp_path / "band.yaml").write_text(BAND)
    item = state(1)
    steps = list(item.steps)
    steps[1] = steps[1]._replace(kind="warm_up")
    found = evaluate_band(steps, load_tolerance(tmp_path / "band.yaml"))
    assert found[0].verdict == "open"


def test_a_step_of_another_speed_is_no_step_of_the_point(tmp_path):
    """4.5 % beside it the interval of the force is wider than the measurement's own."""
    (tmp_path / "band.yaml").write_text(BAND.replace("0.1,", "0.1045,"))
    found = judged_by(state(1), tmp_path / "band.yaml")
    assert found[0].force.high - found[0].force.low > 100.0


@pytest.mark.slow
def test_the_command_says_pass_or_fail(tmp_path):
    path = written(tmp_path / "dyno.csv", columns(5))
    rows = "0.1,350,380,20,50\n0.3,650,680,-280,-250\n\n"  # as a spreadsheet writes it
    (tmp_path / "good.csv").write_text(f"\ufeff{HEADER}\n{rows}")
    (tmp_path / "bad.csv").write_text(f"{HEADER}\n0.1,350,380,40,50\n")
    for name, code, failures in (("good", 0, "0"), ("bad", 1, "1")):
        junit, out = tmp_path / f"{name}.xml", tmp_path / name
        given = ["--tolerance", str(tmp_path / f"{name}.csv"), "--serial", "0815"]
        ended = CliRunner().invoke(
            app, ["characterise", str(path), *given, "--junit", str(junit), "--out", str(out)]
        )
        assert ended.exit_code == code, ended.output
        assert ElementTree.parse(junit).getroot().get("failures") == failures
        page = (out / "report.html").read_text()
        assert "0815" in page
        assert f"<title>{'PASS' if code == 0 else 'FAIL'}: dyno.csv</title>" in page
        content = json.loads((out / "characteristics.json").read_text())
        assert {point["verdict"] for point in content["records"][0]["points"]} >= (
            {"pass"} if code == 0 else {"fail"}
        )


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.yaml", "name: x\npoints: []\n", "points"),
        ("a.yaml", BAND.replace("0.2,", "0.05,"), "expected velocities that increase"),
        ("a.yaml", BAND.replace("350", "390"), "compression_low_n 390"),
        ("a.yaml", BAND.replace("0.2,", "true,"), "velocity_m_per_s"),
        ("a.csv", "v,f\n1,2\n", "expected the header"),
        (
            "a.csv",
            f"{HEADER}\n0.1,350,380,x,50\n",
            "line 2: rebound_low_n = 'x', expected a number",
        ),
        ("a.csv", f"{HEADER}\n", "holds no point"),
        ("a.csv", "", "expected the header"),
    ],
)
def test_a_wrong_band_is_one_line(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as refused:
        load_tolerance(tmp_path / name)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_the_compare_command(tmp_path):
    files = [
        str(written(tmp_path / f"{gas}.csv", columns(gas, gas_n=float(gas))))
        for gas in (150, 200, 250)
    ]
    runner = CliRunner()
    ended = runner.invoke(app, ["compare", files[0], files[1], "--json"])
    assert ended.exit_code == 0, ended.output
    first = json.loads(ended.stdout)["differences"][0]
    assert first["differs"]
    told = runner.invoke(app, ["compare", *files[:2]]).output
    assert "Differs (" in told
    assert "Equal within the interval (" in told
    doses = [word for dose in ("1", "2", "nan") for word in ("--dose", dose)]
    refused = runner.invoke(app, ["compare", *files, *doses]).exception
    assert "expected finite numbers" in str(refused)
    doses = [word for dose in ("1.5", "2.0", "2.5") for word in ("--dose", dose)]
    ended = runner.invoke(app, ["compare", *files, *doses, "--json"])
    trends = {item["figure"]: item for item in json.loads(ended.stdout)["trends"]}
    assert trends["gas force"]["slope"]["value"] == pytest.approx(100.0, rel=0.02)
    assert isinstance(runner.invoke(app, ["compare", files[0]]).exception, InputError)
