"""The diagnosis as a value, and its JSON."""

import dataclasses
import json
import math
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from dart_model.spec import ModelSpec, dump_model

Verdict = Literal["nothing_missing", "explained", "partly_explained", "ambiguous", "not_explained"]

SCHEMA = 1


@dataclass(frozen=True)
class Estimate:
    """A parameter and its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class FoundEffect:
    """An effect that the model lacks.

    Attributes:
        family: Family.
        name: Effect in the catalogue.
        strut: Strut that it acts in.
        explained_fraction: Share of the missing force's mean square that it explains, the other
            effects being in the model.
        parameters: Estimates by name.
        force_rms_n: Root mean square of its force along the runs.
    """

    family: str
    name: str
    strut: str
    explained_fraction: float
    parameters: dict[str, Estimate]
    force_rms_n: float


@dataclass(frozen=True)
class RejectedEffect:
    """A rival, and why it was not chosen."""

    family: str
    name: str
    why: str
    strut: str = ""


@dataclass(frozen=True)
class BeforeAfter:
    """A figure of the model as given, and of the corrected model."""

    before: float
    after: float


@dataclass(frozen=True)
class RunFigures:
    """Figures of one held-out run."""

    run: str
    height_rmse_m: BeforeAfter
    residual_force_rmse_n: BeforeAfter
    strut_force_rmse_n: BeforeAfter | None


@dataclass(frozen=True)
class HeldOut:
    """Figures over all held-out runs, and which part of the data that was.

    Attributes:
        height_rmse_m: Open loop, with the applied force as the only input.
        residual_force_rmse_n: Force that the model lacks along the measured motion.
        strut_force_rmse_n: Against the load cell, where there is one.
        runs: Each run.
        source: ``runs``, or ``end of the run`` where no run was held out.
    """

    height_rmse_m: BeforeAfter
    residual_force_rmse_n: BeforeAfter
    strut_force_rmse_n: BeforeAfter | None
    runs: tuple[RunFigures, ...]
    source: str


@dataclass(frozen=True)
class NoiseFloor:
    """What remains if a model is perfect."""

    height_rmse_m: float
    residual_force_rmse_n: float


@dataclass(frozen=True)
class White:
    """Whether what remains is white."""

    before: bool
    after: bool


@dataclass(frozen=True)
class Diagnosis:
    """What a model lacks. Fields as in ``diagnosis.json``.

    Attributes:
        verdict: What can be said.
        effects: Effects found, strongest first.
        rejected: Rivals.
        ambiguous_with: Families that this run cannot tell from what was found.
        suggested_excitation: What run would tell them apart.
        held_out: Figures on data that was not used to choose.
        noise_floor: What a perfect model would leave.
        residual_white: Whether what remains is white.
        sentence: The finding, as one sentence.
        runs: Names of the runs that were learnt from.
        model: Name of the model.
    """

    verdict: Verdict
    effects: tuple[FoundEffect, ...]
    rejected: tuple[RejectedEffect, ...]
    ambiguous_with: tuple[str, ...]
    suggested_excitation: str | None
    held_out: HeldOut
    noise_floor: NoiseFloor
    residual_white: White
    sentence: str
    runs: tuple[str, ...]
    model: str


def to_json(diagnosis: Diagnosis) -> str:
    """The diagnosis as JSON text; numbers that are not finite become null."""
    data = {"schema": SCHEMA} | dataclasses.asdict(diagnosis)
    return json.dumps(_finite(data), indent=2, ensure_ascii=False) + "\n"


def _finite(value: object) -> object:
    if isinstance(value, dict):
        items = cast("dict[object, object]", value).items()
        return {str(key): _finite(item) for key, item in items}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in cast("list[object]", value)]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_results(diagnosis: Diagnosis, corrected: ModelSpec, folder: Path) -> None:
    """Write ``diagnosis.json`` and ``corrected.yaml``, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "corrected.yaml", dump_model(corrected))
    write_text(folder / "diagnosis.json", to_json(diagnosis))


def write_text(path: Path, text: str) -> None:
    """Write a file so that nobody ever sees half of it."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(name).chmod(0o644)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
