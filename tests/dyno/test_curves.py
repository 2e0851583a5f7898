"""Forces at speeds as numbers, a window of temperatures, inertia, and notes of the build."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from can_dbc.errors import InputError
from rig.dyno.build_notes import differing_notes, read_build_notes
from rig.dyno.characterise import characterise, characterise_record
from rig.dyno.figures import ForceRecord
from rig.dyno.request import FigureRequest
from rig.formats.curve_table import COLUMNS, write_curve_table
from tests.dyno.days import usual
from tests.dyno.population import gas, law

PER_KELVIN = -0.004


def day(**changes):
    """A usual day, whose second speed is run again when the damper is warm."""
    made = usual(warms_k=20.0, per_kelvin=PER_KELVIN, rate_hz=500.0, **changes)
    return replace(made, steps=(made.steps[3], *made.steps))


def record_of(made, seed=4):
    return ForceRecord("day", *made.record(seed), temperature_c=made.temperatures(seed))


@pytest.fixture(scope="module")
def found():
    request = FigureRequest(reference_c=22.0, speeds_m_per_s=(0.05, 0.1, 0.3, 2.0))
    return characterise_record(record_of(day()), request)


def test_both_halves_and_the_peak_are_the_law_at_that_speed(found):
    """Gas is removed at the height at which the speed is passed, and friction remains."""
    made = day()
    assert {point.speed_m_per_s for point in found.curves} == {0.05, 0.1, 0.3}
    assert {point.part for point in found.curves} == {"peak", "opening", "closing"}
    for point in found.curves:
        sign = -1.0 if point.side == "compression" else 1.0
        warmer = 1.0 if point.temperature_c is None else (
            1.0 + PER_KELVIN * (point.temperature_c - 22.0)
        )  # fmt: skip
        damping_n = warmer * float(law(made.damper, np.array(sign * point.speed_m_per_s)))
        truth_n = damping_n - sign * made.damper.friction_n
        if point.step is not None:
            assert point.damping_n.value == pytest.approx(truth_n, abs=6.0)


def test_a_force_at_the_reference_temperature_is_the_cold_one(found):
    made = day()
    warm = [point for point in found.curves if point.at_reference_n is not None]
    assert warm
    for point in warm:
        if point.part == "peak":
            sign = -1.0 if point.side == "compression" else 1.0
            cold_n = made.force(np.zeros(1), np.array([sign * point.speed_m_per_s]), 0.0)[0]
            assert point.at_reference_n.value == pytest.approx(cold_n, abs=0.02 * abs(cold_n))


def test_a_record_of_one_temperature_gives_none_at_another():
    cold = characterise_record(record_of(usual(rate_hz=500.0)), FigureRequest(reference_c=60.0))
    assert all(point.at_reference_n is None for point in cold.curves)
    assert "no force at 60 °C" in " ".join(cold.quality)


def test_steps_outside_a_temperature_window_are_rejected_with_their_temperature(found):
    warm_c = [step.temperature_c for step in found.steps]
    limit_c = 0.5 * (warm_c[0] + warm_c[1])
    gated = characterise_record(record_of(day()), FigureRequest(warm_c=(limit_c, 90.0)))
    assert len(gated.steps) == sum(at_c > limit_c for at_c in warm_c) < len(warm_c)
    assert f"at {warm_c[0]:.1f} °C, outside" in " ".join(gated.quality)
    with pytest.raises(InputError, match="no step between 80 and 90"):
        characterise_record(record_of(day()), FigureRequest(warm_c=(80.0, 90.0)))
    cold = record_of(day())._replace(temperature_c=None)
    with pytest.raises(InputError, match="has no temperature"):
        characterise_record(cold, FigureRequest(warm_c=(10.0, 90.0)))


@pytest.mark.parametrize("mass_kg", [0.5, 3.0])
def test_the_inertia_between_cell_and_strut_is_removed(mass_kg):
    """The cell reads the strut's force less mass times acceleration."""
    made = usual()
    t_s, height_m, force_n = made.record(2)
    acceleration = np.gradient(made.motion(t_s)[1], t_s)
    held_n = force_n - mass_kg * np.where(np.abs(acceleration) < 100.0, acceleration, 0.0)
    record = ForceRecord("moved", t_s, height_m, held_n)
    request = FigureRequest(moving_mass_kg=mass_kg, lag_s=0.0)
    right, raw = (
        characterise_record(record, request),
        characterise_record(record, FigureRequest(lag_s=0.0)),
    )
    x_m = np.linspace(-0.9, 0.9, 2001) * made.steps[0].amplitude_m
    rate = -float(np.polyfit(x_m, gas(made.damper, x_m), 1)[0])
    fastest = right.steps[-1].spring_rate_n_per_m
    assert fastest.value == pytest.approx(rate, rel=0.02)
    apart = raw.steps[-1].spring_rate_n_per_m.value - fastest.value
    assert apart == pytest.approx(-mass_kg * made.steps[-1].omega ** 2, rel=0.02)


def test_the_table_has_a_row_for_each_point(found, tmp_path):
    write_curve_table([found], tmp_path / "curves.csv")
    rows = list(csv.DictReader((tmp_path / "curves.csv").read_text().splitlines()))
    assert len(rows) == len(found.curves)
    assert tuple(rows[0]) == COLUMNS
    openpyxl = pytest.importorskip("openpyxl")
    write_curve_table([found], tmp_path / "curves.xlsx")
    cells = list(openpyxl.load_workbook(tmp_path / "curves.xlsx").worksheets[0].values)
    assert cells[0] == COLUMNS
    values = [point.force_n.value for point in found.curves]
    assert [row[6] for row in cells[1:]] == pytest.approx(values)


def test_notes_of_the_build_go_where_the_record_goes(tmp_path):
    t_s, height_m, force_n = usual(rate_hz=200.0).record(1)
    path = tmp_path / "0815.csv"
    table = np.column_stack([t_s, height_m, force_n])
    header = "t_s,height_m,strut_force_n"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.6f")
    assert read_build_notes(path) == {}
    notes = path.with_suffix(".build.yaml")
    notes.write_text("valve: digressive\npressure_bar: 16\n")
    assert characterise(path).as_dict()["build"] == {"valve": "digressive", "pressure_bar": "16"}
    notes.write_text("valve: [1, 2]\n")
    with pytest.raises(InputError, match=r"0815.build.yaml: valve: .*, expected a text"):
        characterise(path)


def test_notes_that_differ_are_named():
    left, right = {"oil": "SAE 5", "shims": "8 x 0.15"}, {"oil": "SAE 5", "valve": "b"}
    assert differing_notes([left, right]) == [
        "shims: 8 x 0.15, not stated",
        "valve: not stated, b",
    ]
