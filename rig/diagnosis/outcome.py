"""The outcome of a diagnosis, as a value, and its JSON."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from can_dbc.atomic_file import write_durably
from dart_model.spec import ModelSpec, copy_files, dump_model
from rig.diagnosis.recording_bounds import Determinable
from rig.files.json_text import json_text

Array = NDArray[np.float64]
Verdict = Literal["nothing_missing", "explained", "partly_explained", "ambiguous", "not_explained"]
Change = Literal["refitted", "superfluous"]
Confirmation = Literal["confirmed", "unsettled", "not_exercised", "contradicted"]

IMPROBABLE = 4.0
"""Standard deviations of the model file's values beyond which one in some ten thousand lies."""
_FOUR_DEVIATIONS = 2.0
"""In halves of a 95 % interval."""
SCHEMA = 1
DIAGNOSIS_FILE, CORRECTED_FILE, REPORT_FILE = "diagnosis.json", "corrected.yaml", "report.html"


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % confidence interval; an end is None where it is not identifiable."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class LinearCorrection:
    """What the data correct in the linear part of the nominal model.

    Attributes:
        strut: Strut that it belongs to.
        parameter: ``mass_kg`` (of the strut's upper body and what it carries),
            ``stiffness_n_per_m``, ``damping_n_s_per_m``, ``preload_n``, ``free_length_m`` or
            ``input_gain``.
        nominal: Its value in the model file, the preload about mid-stroke.
        total: Its value by the data.
        about_height_m: Mid-stroke, about which stiffness and preload are taken; else None.
        deviations: Distance of the two in standard deviations of the nominal value: those that the
            model file states, or usual ones.
    """

    strut: str
    parameter: str
    nominal: float
    total: Estimate
    about_height_m: float | None
    deviations: float = 0.0

    @property
    def is_improbable(self) -> bool:
        """Whether the model file is unlikely to be as far off."""
        return abs(self.deviations) > IMPROBABLE


@dataclass(frozen=True)
class ChannelCorrection:
    """What the data correct in the measurement.

    Attributes:
        channel: Column of the recordings, as ``height_m:strut``.
        parameter: ``delay_s``: by how much later the channel shows what is true than the first
            input of a driven bench, or than the height where the motion is prescribed. ``gain``:
            how many times the motion of a height it shows, against a measured motion of the base.
        nominal: What the recordings were corrected by already.
        total: Its value by the data.
    """

    channel: str
    parameter: str
    nominal: float
    total: Estimate

    @property
    def is_wrong(self) -> bool:
        """Whether its value is another one than it was taken for, by four standard deviations."""
        low, high = self.total.low, self.total.high
        if low is None or high is None:
            return False
        half = max(high - self.total.value, self.total.value - low)
        return abs(self.total.value - self.nominal) > _FOUR_DEVIATIONS * half


@dataclass(frozen=True)
class LikelihoodGain:
    """Gain of the corrected model's likelihood over another model's, on blocks left out of fits.

    Attributes:
        over: Effects of the other model; none are those of the best linear model.
        log_likelihood: Gain of its logarithm; the noise is what the corrected model leaves, at
            least the sensors'.
        error_ratio: RMS residual of the other model over that of the corrected one, or the
            geometric mean of the blocks' ratios where that is surer; it is beyond each end with the
            diagnosis's level; over a model without a law, over all laws together.
    """

    over: tuple[str, ...]
    log_likelihood: float
    error_ratio: Estimate


@dataclass(frozen=True)
class Evidence:
    """The evidence for an effect.

    Attributes:
        without: Gain over the best model of the other effects.
        rival: Gain over the best model with no effect of its family in its strut, but with others;
            None where none was fitted.
        held_out: ``confirmed``; ``unsettled``: it gains there, but the model leaves so much that it
            may stand in for what is still missing; ``not_exercised``: the effect would not show
            there; ``contradicted``: it would, and the data are as well described without it.
        held_out_log_likelihood: Gain by it on the held-out data, the linear part being free.
    """

    without: LikelihoodGain
    rival: LikelihoodGain | None
    held_out: Confirmation
    held_out_log_likelihood: float


Interval = tuple[float, float]
"""Its lower and its upper end."""


@dataclass(frozen=True)
class ActingRange:
    """Where the recordings show an effect; beyond what was recorded they say nothing of it.

    Attributes:
        height_m: Parts of the recorded heights in which its force stands out from what the
            corrected model leaves.
        velocity_m_per_s: Likewise of the velocities; positive is rebound.
        recorded_height_m: Heights that were recorded.
        recorded_velocity_m_per_s: Likewise.
    """

    height_m: tuple[Interval, ...]
    velocity_m_per_s: tuple[Interval, ...]
    recorded_height_m: Interval
    recorded_velocity_m_per_s: Interval


@dataclass(frozen=True)
class FoundEffect:
    """An effect that the nominal model lacks.

    Attributes:
        family: Family.
        name: Effect in the catalogue.
        strut: Strut that it acts in.
        explained_fraction: Share of the residual force's mean square that it explains, all other
            corrections being in the model.
        force_rms_n: Root mean square of its force along the recordings.
        parameters: Estimates by name.
        evidence: What speaks for it; None of a linear correction and a table.
        where: Where it acts; None of a linear correction.
    """

    family: str
    name: str
    strut: str
    explained_fraction: float
    force_rms_n: float
    parameters: dict[str, Estimate]
    evidence: Evidence | None = None
    where: ActingRange | None = None

    @property
    def is_candidate(self) -> bool:
        """Whether held-out data leave open that it is missing."""
        return self.evidence is not None and self.evidence.held_out != "confirmed"


@dataclass(frozen=True)
class ExistingEffect:
    """An effect that the nominal model has and that the data change.

    Attributes:
        name: Effect in the catalogue.
        strut: Strut that it acts in.
        change: ``refitted``: other parameters; ``superfluous``: the data are as well described
            without it.
        nominal: Its parameters in the model file.
        parameters: Its parameters by the data; empty where it is superfluous.
    """

    name: str
    strut: str
    change: Change
    nominal: dict[str, float]
    parameters: dict[str, Estimate]


@dataclass(frozen=True)
class RejectedEffect:
    """A candidate that was not chosen.

    Attributes:
        family: Family.
        name: Effect in the catalogue.
        strut: Strut on which it was tested.
        why: One line.
        left: RMS residual with it and the corrected linear part, as a share of the best linear
            model's (1: it explains nothing): in simulation, out of sample, where it was fitted
            there, else along the motion; None where it was not tested.
    """

    family: str
    name: str
    strut: str
    why: str
    left: float | None


@dataclass(frozen=True)
class DamperForce:
    """Force of a corrected strut's damper at a velocity, without spring, friction and stops.

    Attributes:
        strut: Strut that it belongs to.
        velocity_m_per_s: Velocity; positive is rebound.
        force_n: Linear damping and laws of the damper, at mid-stroke; negative in rebound.
        damping_n_s_per_m: Slope there: decrease of the force over velocity.
    """

    strut: str
    velocity_m_per_s: float
    force_n: Estimate
    damping_n_s_per_m: Estimate


@dataclass(frozen=True)
class ModelErrors:
    """RMS error of three models on the same data, in one unit; NaN where it is not known.

    Attributes:
        before: Of the nominal model.
        linear: Of the best linear model: corrected in its linear part alone.
        after: Of the corrected model.
        signal: RMS of what is measured, or modelled, about its mean.
    """

    before: float
    linear: float
    after: float
    signal: float


@dataclass(frozen=True)
class RunFigures:
    """Figures of one held-out run.

    Attributes:
        run: Its name.
        height_rmse_m: Open loop, in DART but for the best linear model; NaN where the motion is
            prescribed.
        residual_force_rmse_n: Force that the model lacks along the smoothed motion; the signal is
            the force of the corrected model's struts there.
        strut_force_rmse_n: Against the load cell, where there is one.
    """

    run: str
    height_rmse_m: ModelErrors
    residual_force_rmse_n: ModelErrors
    strut_force_rmse_n: ModelErrors | None


@dataclass(frozen=True)
class HeldOut:
    """Figures over all held-out runs.

    Attributes:
        height_rmse_m: Open loop, driven by the measured inputs alone.
        residual_force_rmse_n: Force that the model lacks along the motion.
        strut_force_rmse_n: Against the load cell, where there is one.
        runs: Each run.
        source: ``runs``, or ``blocks`` where no run was held out and blocks of the recordings were.
    """

    height_rmse_m: ModelErrors
    residual_force_rmse_n: ModelErrors
    strut_force_rmse_n: ModelErrors | None
    runs: tuple[RunFigures, ...]
    source: Literal["runs", "blocks"]


@dataclass(frozen=True)
class NoiseFloor:
    """RMS that a right model can reach on the held-out data."""

    height_rmse_m: float
    residual_force_rmse_n: float


@dataclass(frozen=True)
class White:
    """Whether the residual passes the whiteness test."""

    before: bool
    after: bool


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of a nominal model. Fields as in ``diagnosis.json``.

    Attributes:
        verdict: What held-out data show.
        linear: Linear corrections.
        effects: Missing effects, strongest first; where there are linear corrections alone, these.
        existing: Effects of the nominal model that the data change.
        rejected: Candidates that were not chosen, best first.
        ambiguous_with: Families that these recordings cannot distinguish from the effects.
        suggested_excitation: A recording that would distinguish them, or confirm candidates.
        left: RMS residual of the effects, out of sample, as a share of the best linear model's;
            None without laws of the search.
        held_out: Figures on data that took no part in the search.
        noise_floor: RMS that a right model can reach there.
        residual_white: Whether the residual is white.
        notes: Whole sentences: what the data cannot distinguish, what was removed.
        runs: Names of the recordings that were learnt from.
        model: Name of the nominal model.
        damper: Forces of the dampers that laws describe, by velocity; empty without such a law.
        channels: Corrections of the measurement.
        level: Probability of a name where none is missing, which was asked for.
    """

    verdict: Verdict
    linear: tuple[LinearCorrection, ...]
    effects: tuple[FoundEffect, ...]
    existing: tuple[ExistingEffect, ...]
    rejected: tuple[RejectedEffect, ...]
    ambiguous_with: tuple[str, ...]
    suggested_excitation: str | None
    held_out: HeldOut
    noise_floor: NoiseFloor
    residual_white: White
    notes: tuple[str, ...]
    runs: tuple[str, ...]
    model: str
    damper: tuple[DamperForce, ...] = ()
    channels: tuple[ChannelCorrection, ...] = ()
    left: float | None = None
    level: float = 0.01


@dataclass(frozen=True)
class FittedSeries:
    """Residual force of one strut along one recording that was fitted; arrays of shape (N,).

    Attributes:
        run: Name of the recording.
        strut: Name of the strut.
        t_s: Times in s, increasing.
        height_m: Smoothed height.
        velocity_m_per_s: Smoothed velocity.
        residual_before_n: Force that the nominal model lacks.
        residual_after_n: Force that the corrected model lacks.
        residual_std_n: Standard deviation of either, from the smoother.
        damper_before_n: Force of the nominal model's strut without linear spring and preload.
        damper_after_n: The same of the corrected model.
    """

    run: str
    strut: str
    t_s: Array
    height_m: Array
    velocity_m_per_s: Array
    residual_before_n: Array
    residual_after_n: Array
    residual_std_n: Array
    damper_before_n: Array
    damper_after_n: Array


@dataclass(frozen=True)
class HeldOutSeries:
    """One strut along one held-out run: heights, or forces where the motion is prescribed.

    Attributes:
        run: Name of the run.
        strut: Name of the strut.
        unit: ``m`` or ``N``, of the next three.
        t_s: Times in s, increasing, shape (N,).
        measured: Height or load-cell force; NaN where it is missing or not evaluated.
        before: The nominal model, open loop (or driven along the motion).
        after: The corrected model.
        height_m: Measured height, smoothed where the motion is prescribed.
        velocity_m_per_s: Smoothed velocity.
    """

    run: str
    strut: str
    unit: Literal["m", "N"]
    t_s: Array
    measured: Array
    before: Array
    after: Array
    height_m: Array
    velocity_m_per_s: Array


@dataclass(frozen=True)
class DiagnosisSource:
    """A file or model that a diagnosis was made from.

    Attributes:
        role: ``fitted``, ``held out`` or ``nominal model``.
        name: Its path, or the name of the model.
        sha256: Of the CSV file, of a run's steps, or of the model's text, in hex.
    """

    role: str
    name: str
    sha256: str


@dataclass(frozen=True)
class Result:
    """The result of a diagnosis.

    Attributes:
        corrected: The corrected model.
        fitted: Residual forces along the recordings learnt from.
        held_out: Heights or forces along the recordings evaluated on.
        sources: Files of model and recordings.
        determinable: What the recordings learnt from can determine; None where it was not asked.
    """

    diagnosis: Diagnosis
    corrected: ModelSpec
    fitted: tuple[FittedSeries, ...]
    held_out: tuple[HeldOutSeries, ...]
    sources: tuple[DiagnosisSource, ...] = ()
    determinable: Determinable | None = None


def to_json(diagnosis: Diagnosis) -> str:
    """The diagnosis as JSON text; numbers that are not finite become null."""
    return json_text({"schema": SCHEMA} | dataclasses.asdict(diagnosis))


def write_results(result: Result, nominal: ModelSpec, folder: Path) -> None:
    """Write ``diagnosis.json`` and ``corrected.yaml``, each whole or not at all.

    Raises:
        OSError: The folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_durably(folder / CORRECTED_FILE, dump_model(result.corrected))
    write_durably(folder / DIAGNOSIS_FILE, to_json(result.diagnosis))
    copy_files(nominal, folder)
