"""One run of a fleet, from its files to a row. It runs in a worker, and never raises."""

import contextlib
import datetime
import hashlib
import json
import math
import os
import re
import tempfile
import time
from collections.abc import Generator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from fsspec.core import url_to_fs

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text
from dart_model.effects import effect
from dart_model.spec import ModelSpec, parse_model
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.outcome import Estimate, FoundEffect
from rig.diagnosis.refit import refit_parameters
from rig.dyno.build_notes import read_build_notes
from rig.dyno.characterise import characterise
from rig.dyno.curves import peak_force_at
from rig.dyno.figures import SIDES
from rig.dyno.request import STANDARD_SPEEDS_M_PER_S
from rig.fleet.sources import RunSource, printable
from rig.log.file_names import RUN_FILE
from rig.machine.installed_versions import version_of
from rig.recordings.read import read_recording
from rig.recordings.recording import Recording

_PIECE = 1 << 20


class FleetModel(NamedTuple):
    """A model file, the folder of the files that it names, and the hash of all of them."""

    text: str
    folder: str
    sha256: str


@dataclass(frozen=True)
class RunRow:
    """What is known of a run; a row of the store, and one for each of its values.

    Attributes:
        key: Hash of its content, the model and the version: the same run counts once.
        identity: Hash of its location, size and time, the model and the version, by which an
            evaluated run is recognised without being read again.
        model: Name of the model.
        model_sha256: Hash of its file and of the files that it names.
        verdict: Verdict of the diagnosis; empty where it failed.
        error: Why it failed; empty where it did not.
        before: Error of the model on held-out blocks: of the height in m, or of the force in N on a
            prescribed motion.
        after: The same of the corrected model.
        floor: What a right model leaves there.
        build: How the damper was built: notes by name, as JSON; empty without them.
    """

    key: str
    identity: str
    source: str
    bench: str
    damper: str
    date: str
    model: str
    model_sha256: str
    version: str
    verdict: str = ""
    error: str = ""
    build: str = ""
    samples: int = 0
    duration_s: float = math.nan
    before: float = math.nan
    after: float = math.nan
    floor: float = math.nan
    took_s: float = math.nan
    values: tuple["RunValue", ...] = ()


@dataclass(frozen=True)
class RunValue:
    """A number that a run gave.

    Attributes:
        kind: ``model``: a parameter of the model itself, as this run has it; ``found``: of an
            effect that the model lacks; ``figure``: of the damper, as `rig characterise` has it.
        effect: Effect in the catalogue; empty for the linear part and for figures.
        parameter: Name with its unit.
        value: Value in SI.
        low: Lower end of its 95 % interval; NaN where the run does not bound it.
    """

    kind: str
    strut: str
    effect: str
    family: str
    parameter: str
    value: float
    low: float
    high: float


def evaluate_run(source: RunSource, model: FleetModel) -> RunRow:
    """Diagnose a run by itself; what goes wrong is in the row."""
    begun = time.perf_counter()
    try:
        row = _diagnose_run(source, model)
    except InputError as error:
        row = row_without_result(source, model, str(error))
    except Exception as error:  # one bad run never stops the rest
        row = row_without_result(source, model, f"unexpected: {type(error).__name__}: {error}")
    took_s = time.perf_counter() - begun
    # Without the run's own name and place: alike errors are counted as one.
    name = re.escape(source.url.rsplit("/", 1)[-1])
    error = re.sub(rf"[^\s:]*{name}", "run", row.error.replace(source.url, "run"))
    return replace(row, took_s=took_s, error=printable(error)[:500])


def identity_of(source: RunSource, model_sha256: str) -> str:
    """What a run is known by without being read."""
    parts = [source.url, str(source.size), source.stamp, source.bench, source.damper, source.date]
    text = "\0".join([*parts, model_sha256, rig_version()])
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]


def row_without_result(source: RunSource, model: FleetModel, error: str) -> RunRow:
    """The row of a run that could not be evaluated, or is not evaluated yet."""
    identity = identity_of(source, model.sha256)
    return RunRow(
        identity,
        identity,
        printable(source.url),
        source.bench,
        source.damper,
        source.date or source.changed,
        _parse(model).name,
        model.sha256,
        rig_version(),
        error=error,
    )


@lru_cache(maxsize=1)
def rig_version() -> str:
    """The version whose rows these are."""
    return version_of("rig")


@lru_cache(maxsize=4)
def _parse(model: FleetModel) -> ModelSpec:
    return parse_model(model.text, "model", Path(model.folder))


def _diagnose_run(source: RunSource, model: FleetModel) -> RunRow:
    spec = _parse(model)
    with _local(source) as path:
        key = _key(path, model)
        names = [strut.name for strut in spec.struts]
        recording = read_recording(path, names)
        figures = _figures(path, recording)
        build = read_build_notes(path)
        day = source.date or _day_of(path, source) or source.changed
    found = diagnose(spec, [recording]).diagnosis
    own = [
        _value("model", item.strut, item.effect, item.parameter, item.estimate)
        for item in refit_parameters(spec, [recording])
    ]
    new = [value for item in found.effects for value in _effect_values(item)]
    held_out = found.held_out
    heights, forces = held_out.height_rmse_m, held_out.residual_force_rmse_n
    counted, floor = (
        (heights, found.noise_floor.height_rmse_m)
        if math.isfinite(heights.after)
        else (forces, found.noise_floor.residual_force_rmse_n)
    )
    return replace(
        row_without_result(source, model, ""),
        key=key,
        date=day,
        verdict=found.verdict,
        build=json.dumps(build, ensure_ascii=False) if build else "",
        samples=len(recording.t_s),
        duration_s=recording.duration_s,
        before=counted.before,
        after=counted.after,
        floor=floor,
        values=(*own, *new, *figures),
    )


def _value(kind: str, strut: str, name: str, parameter: str, estimate: Estimate) -> RunValue:
    low = math.nan if estimate.low is None else estimate.low
    high = math.nan if estimate.high is None else estimate.high
    family = effect(name).family if name else ""
    return RunValue(kind, strut, name, family, parameter, estimate.value, low, high)


def _effect_values(item: FoundEffect) -> list[RunValue]:
    """What an effect is worth, and its parameters; of a table without a name the worth alone."""
    worth = Estimate(item.force_rms_n, None, None)
    listed = {} if item.name == "restoring_surface" else item.parameters
    return [
        _value("found", item.strut, item.name, name, estimate)
        for name, estimate in {"force_rms_n": worth, **listed}.items()
    ]


def _figures(path: Path, recording: Recording) -> list[RunValue]:
    """Figures of a damper that was moved in strokes; none where it was not."""
    if recording.strut_forces_n is None or recording.heights_m.shape[1] != 1:
        return []
    try:
        found = characterise(path)
    except InputError:
        return []
    damper = found.damper
    named = {
        "gas_force_n": damper.gas_force_n,
        "gas_rate_n_per_m": damper.gas_rate_n_per_m,
        "friction_n": damper.friction_n,
        "asymmetry": damper.asymmetry,
        **{
            f"{side}_force_n_at_{speed:g}_m_per_s": peak_force_at(found.steps, side, speed)
            for speed in STANDARD_SPEEDS_M_PER_S
            for side in SIDES
        },
    }
    figures = [
        RunValue("figure", "", "", "", name, figure.value, figure.low, figure.high)
        for name, figure in named.items()
        if figure is not None and figure.is_bounded
    ]
    warm_c = [step.temperature_c for step in found.steps if step.temperature_c is not None]
    if warm_c:
        mean_c = sum(warm_c) / len(warm_c)
        figures.append(
            RunValue("figure", "", "", "", "temperature_c", mean_c, min(warm_c), max(warm_c))
        )
    return figures


@contextlib.contextmanager
def _local(source: RunSource) -> Generator[Path]:
    """The run as files of this machine."""
    if "://" not in source.url:
        yield Path(source.url)
        return
    with tempfile.TemporaryDirectory(prefix="rig-run-") as name:
        target = Path(name) / Path(source.url).name
        try:
            system, root = url_to_fs(source.url)
            if source.is_folder:
                system.get(root + "/", str(target) + "/", recursive=True)
            else:
                system.get_file(root, str(target))
        except (OSError, ValueError, ImportError) as error:
            raise InputError(f"{source.url}: cannot be read ({error})") from error
        yield target


def _key(path: Path, model: FleetModel) -> str:
    """Hash of a run's content, the model and the version."""
    found = hashlib.sha256(f"{model.sha256}\0{rig_version()}\0".encode())
    files = sorted(item for item in path.rglob("*") if item.is_file()) if path.is_dir() else [path]
    for file in files:
        found.update(os.fsencode(f"{file.name}\0") if path.is_dir() else b"")
        try:
            with file.open("rb") as opened:
                while piece := opened.read(_PIECE):
                    found.update(piece)
        except OSError as error:
            raise InputError(f"{file}: cannot be read ({error.strerror})") from error
    return found.hexdigest()[:32]


def _day_of(path: Path, source: RunSource) -> str:
    """The day on which a run of the bridge began; empty for other recordings."""
    if not source.is_folder:
        return ""
    epoch_ns = parse_mapping(read_text(path / RUN_FILE), str(path / RUN_FILE)).get("epoch_ns")
    if not isinstance(epoch_ns, int):
        return ""
    return datetime.datetime.fromtimestamp(epoch_ns / 1e9, datetime.UTC).date().isoformat()
