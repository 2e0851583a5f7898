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
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy import signal

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
from rig.diagnosis.command import diagnose_runs
from rig.diagnosis.on_dart import Simulated, dart_heights
from rig.diagnosis.outcome import CORRECTED_FILE, Diagnosis
from rig.diagnosis.problem.build import build
from rig.diagnosis.problem.contract import Parts, existing_values, nominal
from rig.diagnosis.problem.free_run import FreeRun
from rig.diagnosis.recording import Recording, RecordingError, read_recording
from rig.diagnosis.search.fit import fit
from rig.imports import Mapping, import_table, load_mapping
from rig.pages.report import write_report

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
_SLOW = 0.4
"""Share of the resonance below which a bench answers as its spring."""
_RESONANCE_HZ = 68.0
"""Where the Silverbox resonates, roughly; its diagnosis starts from there."""
_AGREEMENT = 0.02
"""Share of the error to which DART's steps are settled."""

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
    record = read_recording(training)
    model = driven_start(record, "silverbox", _RESONANCE_HZ)
    began_s = time.monotonic()
    told = _within(progress, SILVERBOX, 0.05, 0.95)
    specs = [
        ("rig, rough start", model, f"here: resonance at {_RESONANCE_HZ:g} Hz, damping ratio 0.05")
    ]
    try:
        result = diagnose_runs([training], model, tests, out / "diagnosis", told)
    except RecordingError as error:
        refused = f"refused: {error}"
        rows += [
            Row(SILVERBOX, part.name, _CORRECTED, None, _MV, refused) for part in SILVERBOX_TESTS
        ]
    else:
        how = f"here, in {time.monotonic() - began_s:.0f} s: {_named(result.diagnosis)}"
        write_report(result, out / "diagnosis" / "report.html")
        specs.append((_CORRECTED, load_model(out / "diagnosis" / CORRECTED_FILE), how))
    progress(f"{SILVERBOX}: tests", 0.98)
    for part, path in zip(SILVERBOX_TESTS, tests, strict=True):
        test = read_recording(path)
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


def driven_start(record: Recording, name: str, resonance_hz: float) -> ModelSpec:
    """A rough linear model of a force-driven bench, as one would write it down from its data sheet.

    The stiffness is the ratio of force to height well below the resonance, the mass follows from
    the resonance, the damping ratio is 0.05. Without gravity, because a constant force goes into
    the free length.

    Args:
        record: Run with one height and an applied force.
        name: Name of the model.
        resonance_hz: About where the bench resonates.
    """
    if record.applied_force_n is None:
        raise InputError(f"{record.name}: has no applied_force_n, expected a force-driven bench")
    height_m = record.heights_m[:, 0]
    middle_m = float(np.nanmean(height_m))
    rate_hz = 1.0 / float(np.median(np.diff(record.t_s)))
    spectra = cast("Any", signal)
    size = min(4096, len(record.t_s))
    moved_m = np.nan_to_num(height_m - middle_m)
    frequency_hz, cross = spectra.csd(moved_m, record.applied_force_n, rate_hz, nperseg=size)
    power = spectra.welch(moved_m, rate_hz, nperseg=size)[1]
    slow = (frequency_hz > 0.0) & (frequency_hz < _SLOW * resonance_hz)
    stiffness = float(np.real(cross[slow]).sum() / power[slow].sum())
    omega = 2.0 * np.pi * resonance_hz
    mass_kg = stiffness / omega**2
    return _one_body(name, (mass_kg, 0.1 * mass_kg * omega, stiffness), middle_m)


def _solved(columns: Array, target: Array) -> list[float]:
    """Least squares."""
    return cast(
        "list[float]", cast("Any", np.linalg.lstsq(columns, target, rcond=None))[0].tolist()
    )


def dyno_start(records: Sequence[Recording], name: str) -> ModelSpec:
    """The spring and damper that come nearest to a dyno's load cell; a mass of 1 kg, unseen.

    Args:
        records: Runs with one height, imposed, and a strut force.
        name: Name of the model.
    """
    middle_m = float(np.mean([np.nanmean(record.heights_m) for record in records]))
    columns: list[Array] = []
    forces: list[Array] = []
    for record in records:
        if record.strut_forces_n is None:
            raise InputError(f"{record.name}: has no strut_force_n, expected a load cell")
        height_m = record.heights_m[:, 0]
        velocity = np.gradient(height_m, record.t_s)
        columns.append(np.column_stack([middle_m - height_m, -velocity, np.ones_like(height_m)]))
        forces.append(record.strut_forces_n[:, 0])
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


def open_loop_rmse_m(spec: ModelSpec, record: Recording, skipped: int) -> float:
    """Error of a free-run simulation in DART, its start found in the samples that are skipped.

    Args:
        spec: The model.
        record: Run with an applied force.
        skipped: Samples at the start that do not count.
    """
    given, problem = build(spec, [record], 2, None)
    if not isinstance(problem, FreeRun):
        raise InputError(f"{record.name}: has no applied_force_n, expected a force-driven bench")
    (run,) = problem.runs
    head = np.arange(len(run.grid.t_s)) < skipped
    heads = replace(
        problem, runs=(run._replace(grid=run.grid._replace(fitted=run.grid.fitted & head)),)
    )
    base = nominal(heads)
    none = np.zeros(len(given.linear))
    first = Parts(none, existing_values(heads, base), (heads.start(0, base),))
    found = fit(heads, base, first, none > 0.0, 20, effects=False)
    if found is None:
        return float("nan")
    (start,) = found.parts.starts
    there = problem.simulated(run, base, found.parts, start)
    if there is None:
        return float("nan")
    model = Simulated(spec, base, found.parts)
    tolerance = _AGREEMENT * float(np.nanstd(run.grid.heights_m - there.heights_m))
    heights_m = dart_heights(problem, run, model, start, there.heights_m, tolerance)
    return float(np.sqrt(np.nanmean((run.grid.heights_m - heights_m)[skipped:] ** 2)))


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
    model = dyno_start([read_recording(path) for path in runs], "mr_damper")
    names = (f"rig, linear, {trained_on}", f"rig, corrected, {trained_on}")
    try:
        result = diagnose_runs(runs, model, list(tests.values()), out, progress)
    except RecordingError as error:
        return [Row(DAMPER, test, names[1], None, _PERCENT, f"refused: {error}") for test in tests]
    diagnosis = result.diagnosis
    write_report(result, out / "report.html")
    rows: list[Row] = []
    for (test, path), figures in zip(tests.items(), diagnosis.held_out.runs, strict=True):
        force = read_recording(path).strut_forces_n
        if force is None or figures.strut_force_rmse_n is None:
            continue
        percent = 100.0 / float(np.std(force))
        before, after = figures.strut_force_rmse_n.before, figures.strut_force_rmse_n.after
        start = "here, spring and damper fitted to the training part"
        rows.append(Row(DAMPER, test, names[0], percent * before, _PERCENT, start))
        rows.append(Row(DAMPER, test, names[1], percent * after, _PERCENT, _named(diagnosis)))
    return rows
