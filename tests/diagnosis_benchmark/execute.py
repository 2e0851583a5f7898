"""Fills a slot, diagnoses it as `rig diagnose` does, and keeps the result."""

import json
import math
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

from dart_model.spec import ModelSpec, load_model
from rig.diagnosis.diagnose import diagnose as rig_diagnose
from rig.diagnosis.outcome import to_json
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError
from tests.diagnosis_benchmark.comparable import Interval
from tests.diagnosis_benchmark.judge import Result, judge
from tests.diagnosis_benchmark.live import live_force
from tests.diagnosis_benchmark.live_moving import live_force_of_moving
from tests.diagnosis_benchmark.moving import MovingCase, write_moving
from tests.diagnosis_benchmark.plan import Slot, fill, ratios_of
from tests.truth.files import write_case
from tests.truth.plant import Case


def diagnose(folder: Path) -> tuple[dict, ModelSpec | None]:
    """Diagnose a case's files through the same functions as ``rig diagnose``.

    Returns:
        What ``diagnosis.json`` holds, and the corrected model; where the data were refused, the
        verdict ``failed``, and none.
    """
    model = load_model(folder / "model.yaml")
    try:
        found = rig_diagnose(
            model,
            [read_recording(folder / "train.csv")],
            held_out=[read_recording(folder / "test.csv")],
        )
    except RecordingError as error:
        return failed(str(error)), None
    return json.loads(to_json(found.diagnosis)), found.corrected


def _follow(
    case: Case | MovingCase, corrected: ModelSpec | None, diagnosis: dict, folder: Path
) -> float | None:
    """How a corrected model follows the held-out run, as `Result.live_force_ratio`."""
    if corrected is None:
        return None
    if isinstance(case, MovingCase):
        return live_force_of_moving(case, corrected)
    if case.is_dyno:
        return None
    return live_force(
        corrected,
        read_recording(folder / "test.csv"),
        case.sensors.height_noise_m,
        diagnosis["held_out"]["residual_force_rmse_n"]["after"],
        _late_s(diagnosis),
    )


def _late_s(diagnosis: dict) -> float:
    """By how much later than the applied force the height shows what is true, as found."""
    found = (it["total"] for it in diagnosis["channels"] if it["parameter"] == "delay_s")
    return max([0.0, *(total["value"] for total in found if total["low"] is not None)])


def failed(message: str) -> dict:
    """The answer of a diagnosis that gave none."""
    return {"verdict": "failed", "effects": [], "ambiguous_with": [], "message": message}


def result_path(out: Path, slot: Slot) -> Path:
    """Where a slot's result is kept."""
    return out / "results" / f"{slot.name}.json"


def load_result(path: Path) -> Result:
    """Read a kept result."""
    raw = json.loads(path.read_text(encoding="utf-8"))
    held = tuple(Interval(*entry) for entry in raw.pop("intervals"))
    lists = {key: tuple(value) for key, value in raw.items() if isinstance(value, list)}
    return Result(**(raw | lists), intervals=held)


def crashed(slot: Slot, error: BaseException) -> Result:
    """The result of a slot whose diagnosis broke off."""
    case = fill(slot)
    judged = judge(case, (), failed(repr(error)), slot.name, slot.group)
    return Result(**judged, duration_s=math.nan, live_force_ratio=None)


@contextmanager
def within(limit_s: float) -> Iterator[None]:
    """Break off with a `TimeoutError` what takes longer; only on a process's main thread."""

    def give_up(*_: object) -> None:
        raise TimeoutError(f"no answer within {limit_s:.0f} s")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def execute(slot: Slot, out: Path, limit_s: float) -> Result:
    """Diagnose one slot's case, unless that was done before; a failure is tried again.

    Raises:
        TimeoutError: There is no answer within the limit.
    """
    kept = result_path(out, slot)
    if kept.exists():
        return load_result(kept)
    case = fill(slot)
    folder = out / "cases" / slot.name
    write = write_moving if isinstance(case, MovingCase) else write_case
    write(case, folder)
    ratios = ratios_of(case)
    started = time.perf_counter()
    with within(limit_s):
        diagnosis, corrected = diagnose(folder)
    duration_s = time.perf_counter() - started
    live = _follow(case, corrected, diagnosis, folder)
    judged = judge(case, ratios, diagnosis, slot.name, slot.group)
    result = Result(**judged, duration_s=duration_s, live_force_ratio=live)
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
