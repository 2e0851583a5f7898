"""The Silverbox: an electronic mass on a spring that hardens.

References:
    Wigren, Schoukens, "Three free data sets for development and benchmarking in nonlinear system
    identification", ECC (2013).
    Champneys et al., "Baseline results for selected nonlinear system identification benchmarks",
    arXiv 2405.10779 (2024): split and scores.
"""

import importlib
import importlib.util
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, load_model
from rig.diagnosis.files import diagnose_runs
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.outcome import CORRECTED_FILE
from rig.diagnosis.problem.build import build
from rig.diagnosis.problem.on_dart import dart_heights
from rig.diagnosis.problem.problem import first_starts, nominal, nominal_model
from rig.diagnosis.progress import Progress, within
from rig.diagnosis.search.fit import fit
from rig.formats.mapping import load_mapping
from rig.pages.report import write_report
from rig.plan.config import CONFIGS
from rig.recordings.read import read_recording
from rig.recordings.recording import Recording, RecordingError
from tests.scoreboard.parts import Part, imported
from tests.scoreboard.starts import driven_start
from tests.scoreboard.table import CORRECTED, START, Row, findings

SILVERBOX = "Silverbox"
_FILE = Path("silverbox") / "SNLS80mV.csv"
_MULTISINE_ROWS = 127_400 - 40_650
TRAINING = Part("training", 40_650, 40_650 + _MULTISINE_ROWS * 3 // 4)
TESTS = (
    Part("multisine", TRAINING.last, 127_400),
    Part("arrow, full", 100, 40_575),
    Part("arrow, no extrapolation", 100, 32_100),
)
_SKIPPED_SAMPLES = 50
"""First samples of each test that do not count, as in the published scores."""
_RESONANCE_HZ = 68.0
"""Where the Silverbox resonates, roughly; its diagnosis starts from there."""
_AGREEMENT = 0.02
"""Share of the error to which DART's steps are settled."""

_MV_PER_M = 1000.0 / 0.1
_MV = "RMSE in mV"
_CHAMPNEYS = "Champneys et al. 2024, arXiv 2405.10779"
PUBLISHED: tuple[tuple[str, tuple[float | None, float, float | None]], ...] = (
    ("linear state space", (6.96, 14.4, 6.58)),
    ("polynomial NARX", (0.640, 2.25, 0.571)),
    ("LSTM", (1.50, 2.68, 0.960)),
    ("SUBNET", (0.36, 1.4, 0.32)),
    ("GP NARX", (0.301, 0.60, 0.259)),
    ("PNLSS", (None, 0.26, None)),
)
"""Published models and their RMSE in mV on the tests, in the order of `TESTS`."""


def _table(data_folder: Path | None, out: Path) -> Path | None:
    """The set as a table, from the folder or from the package that users get it through."""
    if data_folder is not None and (data_folder / _FILE).is_file():
        return data_folder / _FILE
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


def silverbox_rows(data_folder: Path | None, out: Path, progress: Progress) -> list[Row]:
    """Figures on the published split, learnt from its training part alone; none without the set."""
    source = _table(data_folder, out)
    if source is None:
        return []
    out = out / "silverbox"
    progress(f"{SILVERBOX}: reading", 0.0)
    mapping = load_mapping(CONFIGS / "silverbox_mapping.yaml")
    training = imported(source, mapping, TRAINING, out / "training.csv")
    tests = [
        imported(source, mapping, part, out / f"{part.name.replace(', ', '_')}.csv")
        for part in TESTS
    ]
    rows = [
        Row(SILVERBOX, part.name, model, value, _MV, _CHAMPNEYS)
        for model, values in PUBLISHED
        for part, value in zip(TESTS, values, strict=True)
    ]
    progress(f"{SILVERBOX}: linear model", 0.05)
    record = read_recording(training)
    model = driven_start(record, "silverbox", _RESONANCE_HZ)
    began_s = time.monotonic()
    share = within(progress, 0.05, 0.95, SILVERBOX)
    specs = [
        (START, model, f"computed here; resonance at {_RESONANCE_HZ:g} Hz, damping ratio 0.05")
    ]
    try:
        result = diagnose_runs([training], model, tests, out / "diagnosis", share)
    except RecordingError as error:
        refused = f"refused: {error}"
        rows += [Row(SILVERBOX, part.name, CORRECTED, None, _MV, refused) for part in TESTS]
    else:
        how = f"computed here in {time.monotonic() - began_s:.0f} s; {findings(result.diagnosis)}"
        write_report(result, out / "diagnosis" / "report.html")
        specs.append((CORRECTED, load_model(out / "diagnosis" / CORRECTED_FILE), how))
    progress(f"{SILVERBOX}: tests", 0.98)
    for part, path in zip(TESTS, tests, strict=True):
        test = read_recording(path)
        for name, spec, origin in specs:
            value = open_loop_rmse_m(spec, test, _SKIPPED_SAMPLES) * _MV_PER_M
            rows.append(Row(SILVERBOX, part.name, name, value, _MV, origin))
    return rows


def open_loop_rmse_m(spec: ModelSpec, record: Recording, skipped: int) -> float:
    """Error of a free-run simulation in DART, its start found in the samples that are skipped.

    Args:
        spec: The model.
        record: Run with an applied force.
        skipped: Samples at the start that do not count.
    """
    problem = build(spec, [record], 2, None)
    if problem.bench != "force_given":
        raise InputError(f"{record.name}: has no applied_force_n, expected a force-driven bench")
    (run,) = problem.runs
    head = np.arange(len(run.grid.t_s)) < skipped
    heads = replace(
        problem, runs=(run._replace(grid=run.grid._replace(fitted=run.grid.fitted & head)),)
    )
    first = nominal_model(heads, first_starts(heads, nominal(heads)))
    found = fit(heads, first, first.parts.linear > 0.0, Effort(20), effects=False)
    if found is None:
        return float("nan")
    there = problem.simulate(run, found.model, found.parts.starts[0])
    if there is None:
        return float("nan")
    tolerance = _AGREEMENT * float(np.nanstd(run.grid.heights_m - there.heights_m))
    start = found.parts.starts[0]
    heights_m = dart_heights(problem, run, found.model, start, there.heights_m, tolerance)
    return float(np.sqrt(np.nanmean((run.grid.heights_m - heights_m)[skipped:] ** 2)))
