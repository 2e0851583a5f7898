"""What is wrong with a record is said in one line."""

import numpy as np
import pytest

from rig.identify.diagnose import diagnose
from rig.identify.records import Record, RecordError, read_csv
from tests.identify import little_bench as bench

N = 400


def columns(**changed):
    t_s = np.arange(N) * 0.005
    rng = np.random.default_rng(0)
    values = {
        "t_s": t_s,
        "height_m": 0.4 + 0.02 * np.sin(5.0 * t_s) + rng.normal(0.0, 1e-5, N),
        "applied_force_n": 30.0 * np.sin(5.0 * t_s),
    }
    return values | changed


def written(path, values):
    lines = [",".join(values)]
    lines += [",".join(repr(float(x)) for x in row) for row in zip(*values.values(), strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def message(path):
    with pytest.raises(RecordError) as caught:
        read_csv(path)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    assert path.name in text
    return text


def test_a_record_is_read(tmp_path):
    values = columns(temperature_c=np.full(N, 21.5))
    record = read_csv(written(tmp_path / "run.csv", values))
    assert record.heights_m.shape == (N, 1)
    np.testing.assert_array_equal(record.applied_force_n, values["applied_force_n"])
    assert record.strut_force_n is None
    assert record.temperature_c[3] == 21.5


def test_columns_come_in_any_order(tmp_path):
    values = columns()
    turned = {name: values[name] for name in ("applied_force_n", "t_s", "height_m")}
    record = read_csv(written(tmp_path / "run.csv", turned))
    np.testing.assert_array_equal(record.t_s, values["t_s"])


BAD_TABLES = {
    "constant height": (columns(height_m=np.full(N, 0.4)), "height_m is constant"),
    "constant force": (columns(applied_force_n=np.full(N, 3.0)), "applied_force_n is constant"),
    "constant load cell": (columns(strut_force_n=np.zeros(N)), "strut_force_n is constant"),
    "not a number": (
        columns(height_m=np.where(np.arange(N) == 7, np.nan, columns()["height_m"])),
        "line 9: height_m is no finite number",
    ),
    "infinite": (
        columns(applied_force_n=np.where(np.arange(N) == 7, np.inf, 1.0)),
        "line 9: applied_force_n is no finite number",
    ),
    "time runs back": (
        columns(t_s=np.where(np.arange(N) == 9, 0.0, np.arange(N) * 0.005)),
        "times that increase",
    ),
    "time in ms": (columns(t_s=np.arange(N) * 5.0), "is the time in s?"),
    "swapped": (
        columns(height_m=200.0 * np.sin(np.arange(N)), applied_force_n=columns()["height_m"]),
        "are the columns swapped",
    ),
    "clipped": (
        columns(height_m=np.minimum(columns()["height_m"], 0.412)),
        "not clipped",
    ),
    "ten samples": ({k: v[:10] for k, v in columns().items()}, "10 samples, expected at least"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_a_table_that_would_mislead_is_refused(tmp_path, name):
    values, expected = BAD_TABLES[name]
    assert expected in message(written(tmp_path / "run.csv", values))


BAD_TEXTS = {
    "": "is empty",
    "t_s,height_m\n": "expected applied_force_n or strut_force_n",
    "t_s,height_mm,applied_force_n\n": "column 'height_mm'",
    "t_s,applied_force_n\n": "column height_m is missing",
    "t_s,t_s,height_m,applied_force_n\n": "twice",
    "t_s,height_m,applied_force_n\n": "holds no samples",
    "t_s,height_m,applied_force_n\n0,1\n": "line 2: 2 values, expected 3",
    "t_s,height_m,applied_force_n\n0,x,1\n": "line 2: height_m = 'x'",
    "\x00\n": "header: column",
}


@pytest.mark.parametrize("text", BAD_TEXTS)
def test_a_text_that_is_no_record_is_refused(tmp_path, text):
    path = tmp_path / "run.csv"
    path.write_text(text, encoding="utf-8")
    assert BAD_TEXTS[text] in message(path)


def test_a_missing_file_and_other_bytes_are_refused(tmp_path):
    assert "cannot be read" in message(tmp_path / "none.csv")
    path = tmp_path / "run.csv"
    path.write_bytes(b"t_s,height_m,applied_force_n\n\xff\xfe\n")
    assert "UTF-8" in message(path)


def refused(record):
    with pytest.raises(RecordError) as caught:
        diagnose(bench.model(), [record])
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def test_a_run_without_motion_is_refused():
    t_s = np.arange(2000) * 0.004
    rng = np.random.default_rng(1)
    heights = 0.35 + rng.normal(0.0, 1e-5, (2000, 1))
    assert "apply a larger force" in refused(Record("still", t_s, heights, 1e-3 * np.sin(t_s)))


def test_swapped_columns_of_a_gentle_run_are_refused():
    record = bench.run(bench.Nothing(), duration_s=4.0)
    swapped = Record(
        "swapped", record.t_s, record.applied_force_n[:, np.newaxis], record.heights_m[:, 0]
    )
    assert "are the columns swapped" in refused(swapped)


def test_a_run_without_applied_force_says_what_it_lacks():
    record = bench.run(bench.Nothing(), duration_s=4.0)
    dyno = Record("dyno", record.t_s, record.heights_m, None, record.applied_force_n)
    assert "no applied_force_n" in refused(dyno)
