"""Fills a slot, diagnoses it with `rig diagnose` as a user would, and keeps the result."""

import json
import shutil
import time
from dataclasses import asdict
from pathlib import Path

from typer.testing import CliRunner

from rig.cli import app
from tests.diagnosis_benchmark.comparable import Interval
from tests.diagnosis_benchmark.judge import Result, judge
from tests.diagnosis_benchmark.plan import Slot, fill
from tests.truth.files import write_case
from tests.truth.simulation import floor_ratios

FAILED = {"verdict": "failed", "effects": [], "ambiguous_with": []}


def diagnose(folder: Path) -> dict:
    """Run ``rig diagnose`` on a case's files.

    Returns:
        Its ``diagnosis.json``; with the verdict ``failed`` and a message if there is none.
    """
    out = folder / "diagnosis"
    shutil.rmtree(out, ignore_errors=True)
    arguments = ["diagnose", str(folder / "train.csv"), "--model", str(folder / "model.yaml")]
    arguments += ["--held-out", str(folder / "test.csv"), "--out", str(out)]
    outcome = CliRunner().invoke(app, arguments)
    path = out / "diagnosis.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    return FAILED | {"message": f"{outcome.exception!r} {outcome.output[-300:]}"}


def result_path(out: Path, slot: Slot) -> Path:
    """Where a slot's result is kept."""
    return out / "results" / f"{slot.name}.json"


def load_result(path: Path) -> Result:
    """Read a kept result."""
    raw = json.loads(path.read_text(encoding="utf-8"))
    held = tuple(Interval(*entry) for entry in raw.pop("intervals"))
    lists = {key: tuple(value) for key, value in raw.items() if isinstance(value, list)}
    return Result(**(raw | lists), intervals=held)


def execute(slot: Slot, out: Path) -> Result:
    """Diagnose one slot's case, unless that was done before; a failure is tried again."""
    kept = result_path(out, slot)
    if kept.exists():
        return load_result(kept)
    case = fill(slot)
    folder = out / "cases" / slot.name
    train, _ = write_case(case, folder)
    ratios = tuple(float(ratio) for ratio in floor_ratios(case, train))
    started = time.perf_counter()
    diagnosis = diagnose(folder)
    duration_s = time.perf_counter() - started
    judged = judge(case, ratios, diagnosis, slot.name, slot.group)
    result = Result(**judged, duration_s=duration_s)
    if result.verdict == "failed":
        return result
    kept.parent.mkdir(parents=True, exist_ok=True)
    partial = kept.with_suffix(".partial")
    partial.write_text(json.dumps(asdict(result)), encoding="utf-8")
    partial.rename(kept)
    if result.right:
        # The seed gives it again; what came out wrong stays for a closer look.
        shutil.rmtree(folder)
    return result
