"""What is read from a CSV, what would mislead and is refused in one line; several recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.errors import InputError
from dart_model.spec import MODELS, load_model
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.problem.build import build
from rig.diagnosis.search.criteria import CRITERIA
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping
from rig.plan.config import CONFIGS
from rig.recordings.read import read_recording
from rig.recordings.recording import Recording, RecordingError
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.answers import is_at_the_floor
from tests.diagnosis.driven import driven_by
from tests.diagnosis.little_dyno import Nothing
from tests.diagnosis.test_prescribed import Friction, Stiffness, Yielding

# Measured data lie beside the checkout, never in it.
MR_DAMPER = Path(__file__).resolve().parents[3] / "shared" / "data" / "mr_damper"

STRUTS = ("tyre", "suspension")


@pytest.fixture(scope="module")
def record() -> Recording:
    return dyno.run(Stiffness(), duration_s=6.0)


# --- Recordings that are refused ---------------------------------------------------------------


def refused(record: Recording, *held_out: Recording, model=None) -> str:
    with pytest.raises(RecordingError) as caught:
        diagnose(model or dyno.model(), [record], held_out)
    said = str(caught.value)
    assert "\n" not in said
    assert record.name in said
    return said


def test_recordings_of_both_kinds_are_refused(record: Recording) -> None:
    driven = replace(record, name="driven", inputs=driven_by(np.sin(9.0 * record.t_s)))
    assert "one kind" in refused(record, driven)


def test_a_cell_with_the_other_sign_is_refused(record: Recording) -> None:
    assert record.strut_forces_n is not None
    assert "sign" in refused(replace(record, strut_forces_n=-record.strut_forces_n))


def test_heights_in_millimetres_are_refused(record: Recording) -> None:
    said = refused(replace(record, heights_m=record.heights_m * 1e3 - 300.0 + 0.3))
    assert "unit" in said


def test_a_recording_that_hardly_moves_is_refused(record: Recording) -> None:
    rng = np.random.default_rng(3)
    still = 0.3 + 1e-5 * rng.standard_normal(record.heights_m.shape)
    assert "stroke" in refused(replace(record, heights_m=still))


def test_a_dead_cell_is_refused(record: Recording) -> None:
    assert record.strut_forces_n is not None
    rng = np.random.default_rng(3)
    dead = 0.01 * rng.standard_normal(record.strut_forces_n.shape)
    assert "strut_force_n" in refused(replace(record, strut_forces_n=dead))


def test_a_clipped_cell_is_refused(record: Recording) -> None:
    assert record.strut_forces_n is not None
    most = 0.7 * float(record.strut_forces_n.max())
    clipped = np.minimum(record.strut_forces_n, most)
    assert "clipped" in refused(replace(record, strut_forces_n=clipped))


def test_fewer_heights_than_struts_are_refused(record: Recording) -> None:
    assert "strut" in refused(record, model=load_model(MODELS / "quarter_car.yaml"))


# --- CSV ---------------------------------------------------------------------------------------


def columns(samples: int = 400) -> dict[str, np.ndarray]:
    """Columns of a recording of two struts."""
    t_s = np.arange(samples) * 2e-3
    return {
        "t_s": t_s,
        "height_m:tyre": 0.29 + 0.004 * np.sin(11.0 * t_s),
        "height_m:suspension": 0.31 + 0.03 * np.sin(7.0 * t_s),
        "applied_force_n": 40.0 * np.sin(7.0 * t_s),
        "strut_force_n:suspension": 150.0 - 25.0 * np.sin(7.0 * t_s + 0.2),
        "temperature_c": 20.0 + t_s,
    }


def single(samples: int = 400) -> dict[str, np.ndarray]:
    """Columns of a recording of one strut."""
    of_two = columns(samples)
    return {
        "t_s": of_two["t_s"],
        "height_m": of_two["height_m:suspension"],
        "applied_force_n": of_two["applied_force_n"],
    }


def written(path: Path, table: dict[str, np.ndarray]) -> Path:
    rows = np.column_stack(list(table.values())).tolist()
    lines = [",".join(table), *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


def test_a_strut_needs_no_name_where_there_is_one(tmp_path: Path) -> None:
    table = single()
    plain = read_recording(written(tmp_path / "plain.csv", table))
    table = {name.replace("height_m", "height_m:strut"): each for name, each in table.items()}
    by_name = read_recording(written(tmp_path / "named.csv", table), ["strut"])
    assert plain.name == "plain.csv"
    for found in (plain, by_name):
        assert found.heights_m.shape == (400, 1)
        np.testing.assert_array_equal(found.heights_m[:, 0], table["height_m:strut"])
        np.testing.assert_array_equal(found.applied_force_n, table["applied_force_n"])
        assert found.strut_forces_n is None
        assert found.temperature_c is None


@settings(max_examples=15, derandomize=True, deadline=None)
@given(order=st.permutations(list(columns())))
def test_columns_may_stand_in_any_order(
    order: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    table = columns()
    path = written(
        tmp_path_factory.mktemp("order") / "two.csv", {name: table[name] for name in order}
    )
    found = read_recording(path, STRUTS)
    np.testing.assert_array_equal(found.t_s, table["t_s"])
    for index, strut in enumerate(STRUTS):
        np.testing.assert_array_equal(found.heights_m[:, index], table[f"height_m:{strut}"])
    np.testing.assert_array_equal(found.applied_force_n, table["applied_force_n"])
    assert found.strut_forces_n is not None
    assert np.all(np.isnan(found.strut_forces_n[:, 0]))
    np.testing.assert_array_equal(found.strut_forces_n[:, 1], table["strut_force_n:suspension"])
    np.testing.assert_array_equal(found.temperature_c, table["temperature_c"])


def test_the_order_of_struts_is_the_models(tmp_path: Path) -> None:
    path = written(tmp_path / "two.csv", columns())
    one, other = read_recording(path, STRUTS), read_recording(path, STRUTS[::-1])
    np.testing.assert_array_equal(one.heights_m, other.heights_m[:, ::-1])


def changed(name: str, values: object) -> dict[str, np.ndarray]:
    table = single()
    table[name] = np.broadcast_to(np.asarray(values, dtype=float), (400,))
    return table


def renamed(old: str, new: str, of: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    return {new if name == old else name: each for name, each in (of or single()).items()}


def without(name: str, of: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
    return {key: each for key, each in (of or single()).items() if key != name}


TIMES = single()["t_s"]

TABLES = {
    "no time": (without("t_s"), None, "t_s"),
    "no height": (without("height_m"), None, "height_m"),
    "no force": (without("applied_force_n"), None, "applied_force_n"),
    "an unknown column": (renamed("height_m", "height_mm"), None, "height_mm"),
    "a motion without a name": (renamed("applied_force_n", "motion_m"), None, "motion_m"),
    "an input without a name": (renamed("applied_force_n", "applied_force_n:"), None, "force_n:"),
    "an acceleration alone": (
        renamed("applied_force_n", "acceleration_m_per_s2:road"),
        None,
        "motion_m:road",
    ),
    "a strut without a name": (renamed("height_m", "height_m:"), None, "height_m:"),
    "an unknown strut": (renamed("height_m", "height_m:tire"), ["tyre"], "'tire'"),
    "an unknown strut's force": (
        renamed("strut_force_n:suspension", "strut_force_n:spring", columns()),
        STRUTS,
        "'spring'",
    ),
    "a strut too few": (without("height_m:tyre", columns()), STRUTS, "height_m:tyre"),
    "a height of which strut": (single(), STRUTS, "height_m:tyre"),
    "a time that goes back": (
        changed("t_s", np.where(np.arange(400) == 99, 0.1, TIMES)),
        None,
        "increase",
    ),
    "a time in ms": (changed("t_s", 1e3 * TIMES), None, "in s"),
    "a time of a few ms": (changed("t_s", 1e-3 * TIMES), None, "in s"),
    "a short recording": (single(150), None, "samples"),
    "a constant height": (changed("height_m", 0.31), None, "constant"),
    "a height in µm": (changed("height_m", 1e6 * single()["height_m"]), None, "unit"),
    "a constant force": (changed("applied_force_n", 12.0), None, "constant"),
    "a height that is no number": (
        changed("height_m", np.where(np.arange(400) == 7, np.nan, single()["height_m"])),
        None,
        "line 9",
    ),
    "an infinite force": (
        changed("applied_force_n", np.where(np.arange(400) == 7, np.inf, TIMES)),
        None,
        "line 9",
    ),
}


def refused_file(path: Path, struts=None) -> str:
    with pytest.raises(RecordingError) as caught:
        read_recording(path, struts)
    said = str(caught.value)
    assert "\n" not in said
    assert said.startswith(f"{path.name}: ")
    return said


@pytest.mark.parametrize("case", TABLES)
def test_a_table_that_would_mislead_is_refused(case: str, tmp_path: Path) -> None:
    table, struts, named = TABLES[case]
    assert named in refused_file(written(tmp_path / "run.csv", table), struts)


TEXT = "t_s,height_m,applied_force_n\n"
BYTES = {
    "nothing": (b"", "empty"),
    "a header alone": (TEXT.encode(), "0 samples"),
    "a column twice": (TEXT.replace("applied_force_n", "height_m").encode(), "twice"),
    "a row too short": (f"{TEXT}0.0,0.3,1.0\n0.1,0.3\n".encode(), "line 3: 2 values, expected 3"),
    "a word": (f"{TEXT}0.0,0.3,1.0\n0.1,low,1.0\n".encode(), "line 3: height_m = 'low'"),
    "no text": (b"\xff\xfe\x00t_s", "UTF-8"),
    "a nought byte": (f"{TEXT}0.0,0.3,\x00\n".encode(), "run.csv"),
}


@pytest.mark.parametrize("case", BYTES)
def test_a_file_that_is_no_table_is_refused(case: str, tmp_path: Path) -> None:
    data, named = BYTES[case]
    (tmp_path / "run.csv").write_bytes(data)
    assert named in refused_file(tmp_path / "run.csv")


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run\.csv: no such run"):
        read_recording(tmp_path / "run.csv")


def table_of(record: Recording) -> dict[str, np.ndarray]:
    """Columns of a recording of one strut."""
    table = {"t_s": record.t_s, "height_m": record.heights_m[:, 0]}
    if record.applied_force_n is not None:
        table["applied_force_n"] = record.applied_force_n
    if record.strut_forces_n is not None:
        table["strut_force_n"] = record.strut_forces_n[:, 0]
    return table


def test_a_clipped_height_is_refused(tmp_path: Path) -> None:
    table = table_of(bench.run(bench.Nothing(), duration_s=6.0))
    low, high = table["height_m"].min(), table["height_m"].max()
    table["height_m"] = np.maximum(table["height_m"], low + 0.15 * (high - low))
    assert "clipped" in refused_file(written(tmp_path / "run.csv", table))


def test_a_strut_that_rests_at_an_end_of_its_stroke_is_not_clipped(tmp_path: Path) -> None:
    record = dyno.run(Nothing(), motion=dyno.resting, height_noise_m=0.0, resolution_m=2e-6)
    found = read_recording(written(tmp_path / "run.csv", table_of(record)))
    np.testing.assert_array_equal(found.heights_m, record.heights_m)


# --- Recordings that are understood ------------------------------------------------------------


def test_missing_heights_and_uneven_times_change_little() -> None:
    whole = dyno.run(Stiffness())
    assert whole.strut_forces_n is not None
    rng = np.random.default_rng(5)
    keep = np.sort(rng.choice(len(whole.t_s), int(0.85 * len(whole.t_s)), replace=False))
    heights = whole.heights_m[keep].copy()
    heights[rng.random(len(keep)) < 0.05] = np.nan
    gaps = Recording("gaps", whole.t_s[keep], heights, {}, whole.strut_forces_n[keep])
    found = diagnose(dyno.model(), [gaps], [whole]).diagnosis
    assert [effect.name for effect in found.effects] == ["linear_stiffness"]
    estimate = found.effects[0].parameters["stiffness_n_per_m"]
    assert estimate.value == pytest.approx(900.0, rel=0.01)


@pytest.mark.long
def test_a_recording_that_begins_within_a_loop_is_no_other_effect() -> None:
    train = dyno.run(Yielding(), state=[0.9])
    test = dyno.run(Yielding(), seed=2, state=[-0.8], motion=dyno.later)
    found = diagnose(dyno.model(), [train], [test]).diagnosis
    assert [effect.name for effect in found.effects] == ["bouc_wen"]
    assert is_at_the_floor(found)


@pytest.mark.long
def test_two_recordings_are_learnt_from_together_and_blocks_of_them_are_kept_back() -> None:
    runs = [dyno.run(Friction(), duration_s=6.0), dyno.run(Friction(), seed=2, motion=dyno.later)]
    result = diagnose(dyno.model(), runs)
    assert result.diagnosis.effects[0].family == "friction"
    assert result.diagnosis.verdict == "explained"
    assert result.diagnosis.held_out.source == "blocks"
    assert result.diagnosis.runs == ("dyno1", "dyno2")
    assert {item.run for item in result.fitted} == {"dyno1", "dyno2"}


def test_a_load_cell_is_judged_where_blocks_were_kept_back() -> None:
    run = bench.run(bench.Nothing())
    problem = build(bench.model(), [run], 32, CRITERIA.held_out_every)
    (kept,) = (grid.held_out for grid in problem.grids)
    cell_n = np.where(kept, 30.0, 1e6)[:, np.newaxis] + 0.1 * run.heights_m
    found = diagnose(bench.model(), [replace(run, strut_forces_n=cell_n)]).diagnosis
    assert found.held_out.source == "blocks"
    assert found.held_out.strut_force_rmse_n.after < 1e4


@pytest.mark.long
def test_nothing_is_said_of_a_height_that_is_prescribed() -> None:
    found = diagnose(dyno.model(), [dyno.run(Nothing())]).diagnosis
    assert np.isnan(found.held_out.height_rmse_m.before)
    assert np.isnan(found.held_out.height_rmse_m.after)
    assert found.held_out.strut_force_rmse_n is not None
    assert {"delay", "unmodelled_mode"} <= {rejected.family for rejected in found.rejected}


def measured(name: str, folder: Path) -> Recording:
    mapping = load_mapping(CONFIGS / "dyno_mapping.yaml")
    report = import_table(MR_DAMPER / f"{name}.txt", mapping, folder / f"{name}.csv")
    t_s, height_m, force_n = np.loadtxt(report.out, delimiter=",", skiprows=1).T
    return Recording(name, t_s - t_s[0], height_m[:, np.newaxis], {}, force_n[:, np.newaxis])


@pytest.mark.long
@pytest.mark.skipif(not MR_DAMPER.is_dir(), reason="no measured data beside the checkout")
def test_the_measured_damper_has_memory(tmp_path: Path) -> None:
    whole = measured("5mm3Hz1A", tmp_path)
    assert whole.strut_forces_n is not None
    half = len(whole.t_s) // 2
    first, second = (
        replace(
            whole,
            name=name,
            t_s=whole.t_s[part],
            heights_m=whole.heights_m[part],
            strut_forces_n=whole.strut_forces_n[part],
        )
        for name, part in (("first", slice(0, half)), ("second", slice(half, None)))
    )
    height = first.heights_m[:, 0]
    rough = np.column_stack([-height, -np.gradient(height, first.t_s), np.ones(half)])
    force_n = whole.strut_forces_n[:half, 0]
    stiffness, damping, force = np.linalg.lstsq(rough, force_n, rcond=None)[0]
    stiffness, damping = max(float(stiffness), 1.0), max(float(damping), 1.0)
    model = dyno.model(stiffness=stiffness, damping=damping, free=float(force) / stiffness)
    found = diagnose(model, [first], [second]).diagnosis
    assert {effect.family for effect in found.effects} & {"hysteresis", "friction"}
    assert len(found.effects) <= 3
    for effect in found.effects:
        for estimate in effect.parameters.values():
            assert estimate.low is not None
            assert estimate.high is not None
    error = found.held_out.strut_force_rmse_n
    assert error is not None
    assert second.strut_forces_n is not None
    assert error.before > 0.25 * np.std(second.strut_forces_n)
    assert error.after < 0.1 * np.std(second.strut_forces_n)
