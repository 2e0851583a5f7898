"""Measured benches that nobody here made: our figures beside the published ones.

Sets that are not there are passed over, and nothing is downloaded.

References:
    Wigren, Schoukens, "Three free data sets for development and benchmarking in nonlinear system
    identification", ECC (2013): the Silverbox.
    Champneys et al., "Baseline results for selected nonlinear system identification benchmarks",
    arXiv 2405.10779 (2024): split and scores.
"""

import csv
import importlib
import importlib.util
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, signal

from dart_model.spec import (
    WORLD,
    BodySpec,
    InlineSkeleton,
    JointSpec,
    ModelSpec,
    StrutSpec,
    load_model,
)
from dart_model.yaml_file import InputError
from rig.config import CONFIGS
from rig.diagnose import CORRECTED_FILE, diagnose_runs, read_record
from rig.identify.correct import dart_heights
from rig.identify.diagnosis import Diagnosis
from rig.identify.judge import first_motion
from rig.identify.records import Record, RecordError
from rig.identify.reduced import grid_of, planted, reduced_model, run, start_of
from rig.imports import Mapping, import_table, load_mapping

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Told what is being done, and the share of it that is done."""

TABLE_FILE, PAGE_FILE = "scoreboard.csv", "scoreboard.md"


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        dataset: The set.
        test: On what it was tested.
        model: Which model.
        value: The figure; None where there is none.
        unit: Its unit.
        source: Where a published figure stands, or how ours came about.
    """

    dataset: str
    test: str
    model: str
    value: float | None
    unit: str
    source: str


class Part(NamedTuple):
    """Rows of a table.

    Attributes:
        name: What they are called.
        first: First row.
        last: Last row, excluded.
    """

    name: str
    first: int
    last: int


SILVERBOX = "Silverbox"
_SILVERBOX_FILE = Path("silverbox") / "SNLS80mV.csv"
_MULTISINE_ROWS = 127_400 - 40_650
SILVERBOX_TRAINING = Part("training", 40_650, 40_650 + _MULTISINE_ROWS * 3 // 4)
SILVERBOX_TESTS = (
    Part("multisine", SILVERBOX_TRAINING.last, 127_400),
    Part("arrow, full", 100, 40_575),
    Part("arrow, no extrapolation", 100, 32_100),
)
_SKIPPED_SAMPLES = 50
_DART_ANGLE = 0.045
"""Angle of the fastest motion, in rad, within a step of DART whose error does not count."""

_CORRECTED = "rig, corrected"
_MV_PER_M = 1000.0 / 0.1
_MV, _PERCENT = "RMSE in mV", "RMSE in % of the force's standard deviation"
_CHAMPNEYS = "Champneys et al. 2024, arXiv 2405.10779"
PUBLISHED: tuple[tuple[str, tuple[float | None, float, float | None]], ...] = (
    ("linear state space", (6.96, 14.4, 6.58)),
    ("polynomial NARX", (0.640, 2.25, 0.571)),
    ("LSTM", (1.50, 2.68, 0.960)),
    ("SUBNET", (0.36, 1.4, 0.32)),
    ("GP NARX", (0.301, 0.60, 0.259)),
    ("PNLSS", (None, 0.26, None)),
)
"""Published models and their RMSE in mV on the tests, in the order of `SILVERBOX_TESTS`."""

DAMPER = "MR damper"
_DAMPER_FOLDER = Path("mr_damper")
_DAMPER_RUN = "5mm3Hz1A"
_DAMPER_OTHERS = ("10mm1Hz1A", "25mm0x5Hz1A", "2mm5Hz1A")
_DAMPER_LEFT_OUT = "10mm1Hz1A"


def run_scoreboard(data_folder: Path | None, out: Path, progress: Progress) -> list[Row]:
    """Diagnose every measured set that is there, and set our figures beside the published ones.

    Args:
        data_folder: Folder with `silverbox/SNLS80mV.csv` and `mr_damper/*.txt`, any of them;
            without it only what the package nonlinear_benchmarks has on this machine is found.
        out: Folder to write into: `scoreboard.csv`, `scoreboard.md`, and a folder for each
            diagnosis.
        progress: Told what is being done.

    Returns:
        All rows, set after set.

    Raises:
        InputError: No set is there, a file is wrong, or `out` cannot be written.
    """
    rows: list[Row] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        silverbox = _silverbox_source(data_folder, out)
        if silverbox is not None:
            rows += _silverbox(silverbox, out / "silverbox", progress)
        if data_folder is not None and (data_folder / _DAMPER_FOLDER).is_dir():
            rows += _damper(data_folder / _DAMPER_FOLDER, out / "mr_damper", progress)
        if not rows:
            raise InputError(
                f"{data_folder or 'no data folder'}: holds no measured set, expected "
                f"{_SILVERBOX_FILE} or {_DAMPER_FOLDER}/*.txt; nonlinear_benchmarks has none here"
            )
        write_scoreboard(rows, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return rows


def write_scoreboard(rows: Sequence[Row], out: Path) -> None:
    """Write the rows as CSV, and as Markdown with one table a set."""
    with (out / TABLE_FILE).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(Row)])
        writer.writerows(astuple(row) for row in rows)
    (out / PAGE_FILE).write_text(page(rows), "utf-8")


def page(rows: Sequence[Row]) -> str:
    """The rows in Markdown: one table a set, a line a model, a column a test."""
    lines: list[str] = []
    for dataset in dict.fromkeys(row.dataset for row in rows):
        own = [row for row in rows if row.dataset == dataset]
        tests = list(dict.fromkeys(row.test for row in own))
        unit = own[0].unit
        lines += [f"## {dataset} ({unit})", "", f"| model | {' | '.join(tests)} | source |"]
        lines.append("|" + "---|" * (len(tests) + 2))
        for model, source in dict.fromkeys((row.model, row.source) for row in own):
            values = {
                row.test: row.value for row in own if (row.model, row.source) == (model, source)
            }
            cells = [_cell(values.get(test)) for test in tests]
            lines.append(f"| {model} | {' | '.join(cells)} | {source} |")
        lines.append("")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _silverbox_source(data_folder: Path | None, out: Path) -> Path | None:
    """The set as a table, from the folder or from the package that users get it through."""
    if data_folder is not None and (data_folder / _SILVERBOX_FILE).is_file():
        return data_folder / _SILVERBOX_FILE
    if importlib.util.find_spec("nonlinear_benchmarks") is None:
        return None
    package = cast("Any", importlib.import_module("nonlinear_benchmarks"))
    utilities = cast("Any", importlib.import_module("nonlinear_benchmarks.utilities"))
    kept = Path(cast("str", utilities.get_tmp_benchmark_directory()))
    # Asked for a set that it has not kept, the package would download it.
    if not (kept / SILVERBOX / "SilverboxFiles.zip").is_file():
        return None
    data = package.Silverbox(train_test_split=False)
    records = cast("Sequence[Any]", data if isinstance(data, list | tuple) else [data])
    longest = max(records, key=len)
    table = out / "silverbox.csv"
    both = np.column_stack([np.asarray(longest.u).ravel(), np.asarray(longest.y).ravel()])
    with table.open("w", encoding="ascii") as file:
        file.write("V1,V2\n")
        file.writelines(f"{u:.9g},{y:.9g}\n" for u, y in both.tolist())
    return table


def _imported(source: Path, mapping: Mapping, part: Part | None, out: Path) -> Path:
    if part is not None:
        rows = {"first_row": part.first, "rows": part.last - part.first}
        mapping = mapping.model_copy(update={"table": mapping.table.model_copy(update=rows)})
    out.parent.mkdir(parents=True, exist_ok=True)
    out.unlink(missing_ok=True)
    import_table(source, mapping, out)
    return out


def _silverbox(source: Path, out: Path, progress: Progress) -> list[Row]:
    progress(f"{SILVERBOX}: reading", 0.0)
    mapping = load_mapping(CONFIGS / "silverbox_mapping.yaml")
    training = _imported(source, mapping, SILVERBOX_TRAINING, out / "training.csv")
    tests = [
        _imported(source, mapping, part, out / f"{part.name.replace(', ', '_')}.csv")
        for part in SILVERBOX_TESTS
    ]
    rows = [
        Row(SILVERBOX, part.name, model, value, _MV, _CHAMPNEYS)
        for model, values in PUBLISHED
        for part, value in zip(SILVERBOX_TESTS, values, strict=True)
    ]
    progress(f"{SILVERBOX}: linear model", 0.05)
    record = read_record(training)
    model = driven_start(record, "silverbox")
    began_s = time.monotonic()
    told = _within(progress, SILVERBOX, 0.05, 0.95)
    specs = [("rig, linear start", model, "here, fitted to the training part")]
    try:
        diagnosis = diagnose_runs([training], model, tests, out / "diagnosis", told)
    except RecordError as error:
        refused = f"refused: {error}"
        rows += [
            Row(SILVERBOX, part.name, _CORRECTED, None, _MV, refused) for part in SILVERBOX_TESTS
        ]
    else:
        how = f"here, in {time.monotonic() - began_s:.0f} s: {_named(diagnosis)}"
        specs.append((_CORRECTED, load_model(out / "diagnosis" / CORRECTED_FILE), how))
    progress(f"{SILVERBOX}: tests", 0.98)
    for part, path in zip(SILVERBOX_TESTS, tests, strict=True):
        test = read_record(path)
        for name, spec, origin in specs:
            value = open_loop_rmse_m(spec, test, _SKIPPED_SAMPLES) * _MV_PER_M
            rows.append(Row(SILVERBOX, part.name, name, value, _MV, origin))
    return rows


def _within(progress: Progress, dataset: str, first: float, last: float) -> Progress:
    def told(what: str, share: float) -> None:
        progress(f"{dataset}: {what}", first + (last - first) * share)

    return told


def _named(diagnosis: Diagnosis) -> str:
    effects = ", ".join(effect.name.replace("_", " ") for effect in diagnosis.effects)
    return f"{diagnosis.verdict.replace('_', ' ')}: {effects or 'nothing found'}"


def driven_start(record: Record, name: str) -> ModelSpec:
    """The linear model of a force-driven bench that runs open loop with the least height error.

    Without gravity, because a constant force goes into the free length.

    Args:
        record: Run with one height and an applied force.
        name: Name of the model.
    """
    if record.applied_force_n is None:
        raise InputError(f"{record.name}: has no applied_force_n, expected a force-driven bench")
    height_m = record.heights_m[:, 0]
    middle_m = float(np.nanmean(height_m))
    first = _dynamic_stiffness(record.t_s, height_m - middle_m, record.applied_force_n)
    model = reduced_model(_one_body(name, first, middle_m))
    nothing, none = planted(()), np.zeros(0)
    grid = grid_of(record, model)
    spread_m = float(np.nanstd(height_m))
    guess = start_of(model, *first_motion(grid), 0)
    speed_m_per_s = float(np.nanstd(np.gradient(height_m, record.t_s)))
    scale = np.array([*first, spread_m, spread_m, speed_m_per_s])

    def missed(x: Array) -> Array:
        mass_kg, damping, stiffness, offset_m = (float(value) for value in (x * scale)[:4])
        struts = np.array([[middle_m + offset_m, stiffness, damping, 0.0]])
        trial = model._replace(mass_kg=np.array([[mass_kg]]), struts=struts)
        there = run(trial, nothing, none, grid, guess + (x * scale)[4:])
        if there is None:  # it runs away, so no worse trial is needed
            return np.full(int(grid.measured.sum()), 1e3)
        return ((grid.heights_m - there.heights_m)[grid.measured] / spread_m).ravel()

    begin = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    found = cast("Any", optimize).least_squares(missed, begin, max_nfev=20)
    mass_kg, damping, stiffness, offset_m = (float(value) for value in (found.x * scale)[:4])
    return _one_body(name, (mass_kg, damping, stiffness), middle_m + offset_m)


def _dynamic_stiffness(t_s: Array, height_m: Array, force_n: Array) -> tuple[float, float, float]:
    """Mass, damping and stiffness from spectra: force = (k - m w^2 + i c w) height."""
    rate_hz = 1.0 / float(np.median(np.diff(t_s)))
    spectra = cast("Any", signal)
    size = min(4096, len(t_s))
    frequency_hz, cross = spectra.csd(height_m, force_n, rate_hz, nperseg=size)
    power = spectra.welch(height_m, rate_hz, nperseg=size)[1]
    omega = 2.0 * np.pi * frequency_hz[1:]
    ratio, weight = cross[1:] / power[1:], np.sqrt(power[1:])
    real = np.column_stack([-(omega**2), np.ones_like(omega)])
    mass_kg, stiffness = _solved(real * weight[:, np.newaxis], ratio.real * weight)
    (damping,) = _solved((omega * weight)[:, np.newaxis], ratio.imag * weight)
    return mass_kg, damping, stiffness


def _solved(columns: Array, target: Array) -> list[float]:
    """Least squares."""
    return cast(
        "list[float]", cast("Any", np.linalg.lstsq(columns, target, rcond=None))[0].tolist()
    )


def dyno_start(records: Sequence[Record], name: str) -> ModelSpec:
    """The spring and damper that come nearest to a dyno's load cell; a mass of 1 kg, unseen.

    Args:
        records: Runs with one height, imposed, and a strut force.
        name: Name of the model.
    """
    middle_m = float(np.mean([np.nanmean(record.heights_m) for record in records]))
    columns: list[Array] = []
    forces: list[Array] = []
    for record in records:
        if record.strut_force_n is None:
            raise InputError(f"{record.name}: has no strut_force_n, expected a load cell")
        height_m = record.heights_m[:, 0]
        velocity = np.gradient(height_m, record.t_s)
        columns.append(np.column_stack([middle_m - height_m, -velocity, np.ones_like(height_m)]))
        forces.append(record.strut_force_n)
    stiffness, damping, force_n = _solved(np.concatenate(columns), np.concatenate(forces))
    stiffness, damping = max(stiffness, 1.0), max(damping, 0.0)
    # A constant force is a longer free length, within reason; the rest is left to be found.
    longer_m = float(np.clip(force_n / stiffness, -0.5 * middle_m, 0.5 * middle_m))
    return _one_body(name, (1.0, damping, stiffness), middle_m + longer_m)


def _one_body(name: str, constants: tuple[float, float, float], free_length_m: float) -> ModelSpec:
    mass_kg, damping_n_s_per_m, stiffness_n_per_m = constants
    body = BodySpec(name="body", mass_kg=mass_kg, joint=JointSpec(type="prismatic"))
    strut = StrutSpec(
        name="strut",
        between=(WORLD, "body"),
        free_length_m=free_length_m,
        stiffness_n_per_m=stiffness_n_per_m,
        damping_n_s_per_m=damping_n_s_per_m,
    )
    return ModelSpec(
        name=name, gravity_m_per_s2=0.0, skeleton=InlineSkeleton(bodies=(body,)), struts=(strut,)
    )


def open_loop_rmse_m(spec: ModelSpec, record: Record, skipped: int) -> float:
    """Error of a model that runs alone in DART, its start found in the samples that are skipped.

    Args:
        spec: The model.
        record: Run with an applied force.
        skipped: Samples at the start that do not count.
    """
    model = reduced_model(spec)
    grid = grid_of(record, model)
    head = grid.rows(0, skipped)
    guess = start_of(model, *first_motion(head), 0)
    steps = max(2, int(np.ceil(model.fastest_rad_per_s * grid.step_s / _DART_ANGLE)))
    scale = np.array(
        [np.nanstd(grid.heights_m), np.nanstd(np.gradient(grid.heights_m[:, 0], grid.t_s))]
    )

    def missed(x: Array) -> Array:
        return (
            head.heights_m - dart_heights(spec, head, guess + x * scale, steps)
        ).ravel() / scale[0]

    found = cast("Any", optimize).least_squares(missed, np.zeros(2), max_nfev=20)
    heights_m = dart_heights(spec, grid, guess + np.asarray(found.x) * scale, steps)
    return float(np.sqrt(np.nanmean((grid.heights_m - heights_m)[skipped:] ** 2)))


def _damper(folder: Path, out: Path, progress: Progress) -> list[Row]:
    progress(f"{DAMPER}: reading", 0.0)
    mapping = load_mapping(CONFIGS / "dyno_mapping.yaml")
    source = folder / f"{_DAMPER_RUN}.txt"
    if not source.is_file():
        return []
    half = sum(1 for _ in source.open("rb")) // 2
    first, second = Part("first half", 0, half), Part("second half", half, 2 * half)
    training = _imported(source, mapping, first, out / "first_half.csv")
    tests = {
        f"{_DAMPER_RUN}, second half": _imported(source, mapping, second, out / "second_half.csv")
    }
    for name in _DAMPER_OTHERS:
        if (folder / f"{name}.txt").is_file():
            tests[name] = _imported(folder / f"{name}.txt", mapping, None, out / f"{name}.csv")
    halfway = _within(progress, DAMPER, 0.0, 0.5)
    rows = _damper_rows("first half", [training], tests, out / "one_run", halfway)
    if _DAMPER_LEFT_OUT in tests:
        others = [training, *(path for name, path in tests.items() if name in _DAMPER_OTHERS)]
        several = [path for path in others if path.stem != _DAMPER_LEFT_OUT]
        left_out = {_DAMPER_LEFT_OUT: tests[_DAMPER_LEFT_OUT]}
        rest = _within(progress, DAMPER, 0.5, 1.0)
        rows += _damper_rows(f"{len(several)} runs", several, left_out, out / "several_runs", rest)
    return rows


def _damper_rows(
    trained_on: str, runs: list[Path], tests: dict[str, Path], out: Path, progress: Progress
) -> list[Row]:
    """Force errors in % of the force's standard deviation, before and after."""
    model = dyno_start([read_record(path) for path in runs], "mr_damper")
    names = (f"rig, linear, {trained_on}", f"rig, corrected, {trained_on}")
    try:
        diagnosis = diagnose_runs(runs, model, list(tests.values()), out, progress)
    except RecordError as error:
        return [Row(DAMPER, test, names[1], None, _PERCENT, f"refused: {error}") for test in tests]
    rows: list[Row] = []
    for (test, path), figures in zip(tests.items(), diagnosis.held_out.runs, strict=True):
        force = read_record(path).strut_force_n
        if force is None or figures.strut_force_rmse_n is None:
            continue
        percent = 100.0 / float(np.std(force))
        before, after = figures.strut_force_rmse_n.before, figures.strut_force_rmse_n.after
        start = "here, spring and damper fitted to the training part"
        rows.append(Row(DAMPER, test, names[0], percent * before, _PERCENT, start))
        rows.append(Row(DAMPER, test, names[1], percent * after, _PERCENT, _named(diagnosis)))
    return rows
