"""Tables of benches with several struts and inputs become the project's CSV."""

from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from dart_model.spec import MODELS, load_model
from rig.channels.measured_quantities import MOTION
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping
from rig.recordings.csv_file import read_csv
from rig.recordings.recording_checks import inputs_of

MAPPING = """
time: {column: t, unit: s}
heights:
  tyre: {column: wheel, unit: mm, less: road}
  suspension: {column: body, unit: mm, less: wheel}
inputs:
  road:
    measures: motion
    column: road
    unit: mm
    acceleration: {column: road_acc, unit: g, reversed: true}
strut_forces:
  suspension: {column: cell, unit: kN, reversed: true}
"""


def mapping(folder: Path, text: str = MAPPING):
    (folder / "mapping.yaml").write_text(text)
    return load_mapping(folder / "mapping.yaml")


def test_positions_become_heights_and_inputs_have_their_names(tmp_path):
    t_s = np.arange(300) * 2e-3
    road, wheel, body = 10.0 * np.sin(9.0 * t_s), 290.0 + 8.0 * np.sin(9.0 * t_s), 650.0 + t_s
    acceleration, cell = np.cos(9.0 * t_s), 0.2 * np.sin(9.0 * t_s)
    table = np.column_stack([t_s, road, wheel, body, acceleration, cell])
    header = "t,road,wheel,body,road_acc,cell"
    np.savetxt(tmp_path / "car.txt", table, "%.9g", ",", header=header, comments="")
    report = import_table(tmp_path / "car.txt", mapping(tmp_path), tmp_path / "car.csv")
    assert report.columns == (
        "t_s",
        "height_m:tyre",
        "height_m:suspension",
        "motion_m:road",
        "acceleration_m_per_s2:road",
        "strut_force_n:suspension",
    )
    read = read_csv(tmp_path / "car.csv", ["tyre", "suspension"])
    np.testing.assert_allclose(read.heights_m[:, 0], (wheel - road) * 1e-3, atol=1e-9)
    np.testing.assert_allclose(read.heights_m[:, 1], (body - wheel) * 1e-3, atol=1e-9)
    (moved,) = inputs_of(read, load_model(MODELS / "quarter_car_road.yaml")).values()
    assert moved.quantity is MOTION
    np.testing.assert_allclose(moved.values, road * 1e-3, atol=1e-9)
    np.testing.assert_allclose(moved.acceleration_m_per_s2, -9.80665 * acceleration, atol=1e-6)
    np.testing.assert_allclose(read.strut_forces_n[:, 1], -1e3 * cell, atol=1e-6)
    assert any("height_m:tyre less 0.001 * column 'road'" in line for line in report.assumptions)


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("heights:", "height: {column: a, unit: mm}\nheights:", "expected one of height and"),
        ("measures: motion", "measures: torque", "acceleration: expected none with measures"),
        ("measures: motion", "measures: speed", "inputs.road.measures"),
        ("unit: g,", "unit: N,", "inputs.road.acceleration.unit"),
        ("unit: mm\n", "unit: Nm\n", "inputs.road.unit"),
        ("less: wheel", "lower: wheel", "heights.suspension.lower"),
    ],
)
def test_a_wrong_key_is_one_line_that_names_it(tmp_path, before, after, named):
    with pytest.raises(InputError, match=r"mapping\.yaml: ") as caught:
        mapping(tmp_path, MAPPING.replace(before, after))
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)
