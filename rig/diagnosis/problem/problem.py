"""A model held against recordings, for every kind of bench.

A problem gives the whitened residual of a candidate model, the same regression along the measured
motion for the screening of laws, and the figures of a model on held-out data. Search, evaluation
and outcome use nothing else of a bench: a further kind of bench is one subclass in one file.

References:
    Ljung, System Identification (1999), 7.2 and 9.4, output error and its covariance.
    Young, Recursive Estimation and Time-Series Analysis (2011), 8, for equation errors that pass
    through the model's own dynamics.
"""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.law import Bench, Motion
from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.delay_step import ForceOverTime
from rig.diagnosis.numerics.laws import Slots, slots
from rig.diagnosis.outcome import HeldOutSeries, ModelErrors, NoiseFloor, RunFigures
from rig.diagnosis.problem.grid import RecordingGrid, SmoothRecording, Track
from rig.diagnosis.problem.mechanism import MechanismPlants

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
StrutEffect = tuple[int, str]
"""Index of a strut, and the name of an effect in it."""

Kind = Literal[
    "mass", "stiffness", "damping", "preload", "gain", "free_length", "delay", "height_gain"
]


class LinearParameter(NamedTuple):
    """A parameter of the linear part, searched as its change against the nominal model.

    Attributes:
        kind: What it is. Stiffness and preload are taken about mid-stroke; the free length is that
            from which laws are taken, its share in the linear spring's force counts as preload.
        deviation: Standard deviation of the prior on its change.
        least: Lowest change; mass stays positive, no spring or damper turns negative.
        input: Of a gain, the index in the input vector of what it is the gain of; of an input's
            delay, its index among the inputs.
        channel: Of a delay, the channel that is late; of a height's gain, that height.
        most: Highest change.
        expected: Mean of the prior on the change.
    """

    strut: int
    kind: Kind
    nominal: float
    deviation: float
    least: float
    input: int = -1
    channel: str = ""
    most: float = np.inf
    expected: float = 0.0


class ExistingParameters(NamedTuple):
    """An effect of the nominal model, with its parameters.

    Attributes:
        free: Whether it is refitted along: linear ones, a table, and what does not act on these
            recordings are not.
    """

    strut: int
    name: str
    values: tuple[float, ...]
    free: bool


class Candidate(NamedTuple):
    """Effects under test: those of the nominal model that stay, by index, and new ones."""

    kept: tuple[int, ...]
    new: tuple[StrutEffect, ...]

    def with_effects(self, *effects: StrutEffect) -> "Candidate":
        """The candidate with further effects, sorted, so that equal sets are equal candidates."""
        return self._replace(new=tuple(sorted({*self.new, *effects})))

    def without(self, strut_effect: StrutEffect) -> "Candidate":
        """The candidate less one effect."""
        return self._replace(new=tuple(other for other in self.new if other != strut_effect))


class Parts(NamedTuple):
    """Values of all that a model's response depends on.

    Attributes:
        linear: Changes of the linear parameters, shape (L,).
        effects: Parameters of all effects, existing ones first, one after another, shape (P,).
        starts: Initial vector of each recording: of a free run coordinates, velocities and the
            internal states of all effects; of a prescribed motion the latter alone.
    """

    linear: Array
    effects: Array
    starts: tuple[Array, ...]


class CandidateModel(NamedTuple):
    """A candidate with its values: a model that can be simulated."""

    candidate: Candidate
    parts: Parts

    def with_linear(self, linear: Array) -> "CandidateModel":
        """The same model with other linear parameters, shape (L,)."""
        return self._replace(parts=self.parts._replace(linear=linear))


class CellDelay(NamedTuple):
    """Delay of a load cell against a model.

    Attributes:
        nominal_s: The part that the recording's times are free of already.
        total_s: The whole delay.
        std_s: Its standard deviation.
    """

    nominal_s: float
    total_s: float
    std_s: float


class ComparedModels(NamedTuple):
    """The models that are compared on held-out data."""

    nominal: CandidateModel
    linear: CandidateModel
    corrected: CandidateModel


class Segment(NamedTuple):
    """A recording or a part of one in the regression along the motion.

    Attributes:
        track: The measured motion, smoothed.
        reference: The motion along which the reference's laws acted.
        lead: Both motions over the whole recording, of which this is a part, for laws whose
            internal state depends on what went before; None where this is all of it.
        respond: Changes of the whitened response, shape (m, k), by forces (N, k) in a strut.
        target: Whitened residual of the reference, shape (m,).
        linear: Whitened responses to a unit change of each linear parameter, shape (m, L).
        initial: Whitened responses to initial states, shape (m, c).
        blocks: Block of each row, counted within the segment, shape (m,).
    """

    track: Track
    reference: Track
    lead: tuple[Track, Track] | None
    respond: Callable[[int, Array], Array]
    target: Array
    linear: Array
    initial: Array
    blocks: Integers


class ResidualForces(NamedTuple):
    """The force that would make the residual of a recording vanish.

    Attributes:
        force_n: The force in each strut, shape (struts, N); NaN where it is not known.
        deviation_n: Its standard deviation, shape (struts, N).
    """

    name: str
    track: Track
    force_n: Array
    deviation_n: Array


class RunEvaluation(NamedTuple):
    """Figures of one held-out recording.

    Attributes:
        drift_m: Share of the floor that noise of the applied force causes; zero on a dyno.
    """

    figures: RunFigures
    floor: NoiseFloor
    drift_m: float
    series: tuple[HeldOutSeries, ...]

    @property
    def target(self) -> ModelErrors:
        """The errors that decide: of the height, or of the force where the motion is prescribed."""
        heights = self.figures.height_rmse_m
        return heights if np.isfinite(heights.after) else self.figures.residual_force_rmse_n

    @property
    def target_floor(self) -> float:
        """The noise floor of these errors."""
        heights = self.floor.height_rmse_m
        return heights if np.isfinite(heights) else self.floor.residual_force_rmse_n


Derivative = Callable[[int, CandidateModel, Flags], Array | None]
"""Derivative of a recording's residual by its varied parts, shape (m, varied).

Of the recording's index, a model, and flags of linear parameters, effects' parameters and initial
vector, one after another. None where the model runs away.
"""


class ProblemBasis(NamedTuple):
    """What the problems of one diagnosis share: the first fields of `Problem`, in their order."""

    spec: ModelSpec
    linear: tuple[LinearParameter, ...]
    existing: tuple[ExistingParameters, ...]
    motions: tuple[Motion, ...]
    block_s: float  # Length of the blocks of cross-validation.
    plants: MechanismPlants


@dataclass(frozen=True, eq=False)
class Problem(ABC):
    """A model held against recordings; fields as in `ProblemBasis`."""

    bench: ClassVar[Bench]
    spec: ModelSpec
    linear: tuple[LinearParameter, ...]
    existing: tuple[ExistingParameters, ...]
    motions: tuple[Motion, ...]
    block_s: float
    plants: MechanismPlants

    @classmethod
    @abstractmethod
    def of_recordings(cls, basis: ProblemBasis, recordings: Sequence[SmoothRecording]) -> Self:
        """The problem of recordings of this kind of bench.

        Raises:
            RecordingError: A channel cannot be what its name says.
        """

    @property
    @abstractmethod
    def assumptions(self) -> tuple[str, ...]:
        """Notes of a diagnosis: what the bench's residual takes for granted."""

    @property
    def is_driven_by_force(self) -> bool:
        """Whether the scale of what drives the bench is that of its forces and masses."""
        return False

    @property
    def height_gains(self) -> tuple[LinearParameter, ...]:
        """Gains of heights that the recordings may determine; none of them is free as yet."""
        return ()

    @property
    @abstractmethod
    def grids(self) -> tuple[RecordingGrid, ...]:
        """Nodes of each recording."""

    @abstractmethod
    def fit_nodes(self, k: int) -> Flags:
        """Nodes of a recording that take part in fits, shape (N,)."""

    @abstractmethod
    def blocks(self, k: int) -> Integers:
        """Block of each row of a recording's residual, counted within it, shape (m,)."""

    @abstractmethod
    def residual(self, k: int, model: CandidateModel) -> Array | None:
        """Whitened residual of a recording, shape (m,); None where the model runs away."""

    @property
    def derivative(self) -> "Derivative | None":
        """The derivative of the residual; None where only differences give it."""
        return None

    @abstractmethod
    def law_responses(
        self, k: int, model: CandidateModel, laws: Sequence[tuple[StrutEffect, Array]]
    ) -> Array | None:
        """Derivative of a recording's residual by shares of further laws, shape (m, laws).

        Each law, with its parameters, acts along the model's own motion. None where the model runs
        away; zero for a law that is not finite there.
        """

    @abstractmethod
    def floor_level(self, model: CandidateModel) -> float:
        """Mean square of a right model's residual: noise of the sensors and the applied force."""

    @abstractmethod
    def start(self, k: int, candidate: Candidate) -> Array:
        """First guess of a recording's initial vector."""

    @abstractmethod
    def start_scales(self, candidate: Candidate) -> tuple[Array, Flags]:
        """Usual sizes of an initial vector's entries, and which of them are fitted."""

    @abstractmethod
    def states(self, k: int, model: CandidateModel) -> Array:
        """Internal states at the beginning of a recording."""

    @abstractmethod
    def residual_forces(self, k: int, model: CandidateModel) -> ResidualForces | None:
        """The residual force of a recording; None where the model runs away."""

    @abstractmethod
    def forces_over_time(
        self, k: int, model: CandidateModel, delays: Sequence[int]
    ) -> Sequence[ForceOverTime] | None:
        """The force of each strut along the measured motion, before the delays of a model.

        `delays` are the delays by which it is differentiated, by index among the linear
        parameters. None where the model runs away.
        """

    @abstractmethod
    def residual_force_rms_n(self, mean_square: float) -> float:
        """RMS residual force of a fit by its whitened mean square; NaN where heights are fitted."""

    @abstractmethod
    def with_noise_of(self, model: CandidateModel) -> Self:
        """The problem with the sensors' noise as a model's residual shows it."""

    @abstractmethod
    def coarser(self, model: CandidateModel) -> Self:
        """The problem with fits in longer steps, as far as a model moves alike in them.

        Laws with internal states are fitted in usual steps.
        """

    @abstractmethod
    def in_usual_steps(self) -> Self:
        """The problem with all fits in usual steps."""

    @abstractmethod
    def finer(self) -> Self | None:
        """The problem with steps half as long as usual ones; None where nothing is integrated."""

    @abstractmethod
    def held_to(self, motions: Sequence[tuple[int, Track]], share: float) -> Self | None:
        """The problem of a model that is held to the motion of each recording, given by its index.

        Springs and dampers hold it, at a share of the rate of its fastest motion: its errors do not
        add up. None where it is moved as measured anyway, or a recording has no motion.
        """

    @abstractmethod
    def cut(self, pieces: Sequence[tuple[int, slice]]) -> Self:
        """The problem of pieces of recordings, each given by its recording's index and its nodes.

        Internal states start again with each piece: those that add up over a recording are wrong.
        """

    @abstractmethod
    def of_held_out_blocks(self) -> Self:
        """The problem of the blocks that are held out, of the recordings that have any."""

    @abstractmethod
    def segments(
        self, model: CandidateModel, most_samples: int, largest_stride: int
    ) -> tuple[Segment, ...]:
        """The regression along the motion about a model, the reference.

        Args:
            model: The reference: its free run, or its force along the motion.
            most_samples: Nodes of all recordings that are taken, about.
            largest_stride: Longer recordings are thinned to one node in so many at most; where that
                leaves too many nodes, parts of the recordings are taken.

        Raises:
            FloatingPointError: The model runs away.
        """

    @abstractmethod
    def evaluate(
        self, k: int, models: ComparedModels, fitted_rms_n: float, *, blocks: bool
    ) -> RunEvaluation:
        """Figures of a held-out recording.

        Args:
            k: Index of the recording.
            models: What is compared, with initial vectors fitted to these recordings.
            fitted_rms_n: Residual force of the corrected model where it was fitted.
            blocks: Whether the figures are those of held-out blocks, not of the whole recording.

        Raises:
            RecordingError: A model runs away.
        """

    def delays_of_cells(self, model: CandidateModel) -> dict[int, CellDelay]:
        """Delays of load cells that take no part in fits, by the index of their strut."""
        del model
        return {}

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return len(self.grids)

    @property
    def basis(self) -> ProblemBasis:
        """What the problem shares with others of the same diagnosis."""
        return ProblemBasis(
            self.spec, self.linear, self.existing, self.motions, self.block_s, self.plants
        )


def select_nodes(grid: RecordingGrid, *, blocks: bool) -> Flags:
    """Nodes of a recording that are evaluated on: its held-out blocks, or all, shape (N,)."""
    return grid.held_out if blocks else np.ones_like(grid.held_out)


def rms(values: Array) -> float:
    """Root mean square of the values that are not NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


def rms_about_mean(values: Array) -> float:
    """RMS about the mean of their column of the values (N, n) that are not NaN."""
    known = values[:, np.any(np.isfinite(values), axis=0)]
    return rms(known - np.nanmean(known, axis=0)) if known.size else np.nan


def quadratic_mean(values: Sequence[float] | Array, weights: Sequence[int] | None = None) -> float:
    """Quadratic mean; NaN if a value is."""
    return float(np.sqrt(np.average(np.square(values), weights=weights)))


def quadratic_means(
    errors: Sequence[ModelErrors], weights: Sequence[int] | None = None
) -> ModelErrors:
    """Quadratic means of the errors of each model, and of the signal."""
    rows = np.array([dataclasses.astuple(item) for item in errors])
    return ModelErrors(*(quadratic_mean(column, weights) for column in rows.T))


def strut_effects(problem: Problem, candidate: Candidate) -> tuple[StrutEffect, ...]:
    """All effects of a candidate, existing ones first."""
    kept = ((problem.existing[i].strut, problem.existing[i].name) for i in candidate.kept)
    return (*kept, *candidate.new)


def slots_of(problem: Problem, candidate: Candidate) -> Slots:
    """All effects of a candidate as the compiled loops read them."""
    return slots(strut_effects(problem, candidate))


def nominal(problem: Problem) -> Candidate:
    """The candidate without new effects."""
    return Candidate(tuple(range(len(problem.existing))), ())


def nominal_model(problem: Problem, starts: tuple[Array, ...]) -> CandidateModel:
    """The nominal model as given, from initial vectors."""
    base = nominal(problem)
    parts = Parts(np.zeros(len(problem.linear)), existing_values(problem, base), starts)
    return CandidateModel(base, parts)


def first_starts(problem: Problem, candidate: Candidate) -> tuple[Array, ...]:
    """First guess of all recordings' initial vectors."""
    return tuple(problem.start(k, candidate) for k in range(problem.recordings))


def existing_values(problem: Problem, candidate: Candidate) -> Array:
    """Parameters of a candidate's existing effects, as the model file has them."""
    parts = [problem.existing[i].values for i in candidate.kept]
    return np.array([value for values in parts for value in values])


def strut_constants(problem: Problem, linear: Array) -> Array:
    """Free length, stiffness, damping, gravity and preload of each strut, shape (struts, 5).

    Stiffness and preload are corrected about mid-stroke, where they are nearly independent.
    """
    spec = problem.spec
    constants = np.array(
        [
            (s.free_length_m, s.stiffness_n_per_m, s.damping_n_s_per_m, spec.gravity_m_per_s2, 0.0)
            for s in spec.struts
        ]
    )
    for parameter, change in zip(problem.linear, linear, strict=True):
        row = constants[parameter.strut]
        if parameter.kind == "stiffness":
            row[1] += change
            row[4] += change * (mid_stroke_m(problem.motions[parameter.strut]) - row[0])
        elif parameter.kind == "damping":
            row[2] += change
        elif parameter.kind == "preload":
            row[4] += change
    for parameter, change in zip(problem.linear, linear, strict=True):
        if parameter.kind == "free_length":
            constants[parameter.strut, 0] += change
            constants[parameter.strut, 4] -= constants[parameter.strut, 1] * change
    return constants


def free_linear(problem: Problem, candidate: Candidate) -> Flags:
    """Linear parameters that are fitted together with a candidate's laws, shape (L,).

    The gain of the applied force is degenerate with all others, and is fitted separately. The free
    length acts only where a law depends on it.
    """
    effects = strut_effects(problem, candidate)
    acting = {strut for strut, name in effects if effect(name).about_free_length}
    return np.array(
        [
            p.kind != "gain" and (p.kind != "free_length" or p.strut in acting)
            for p in problem.linear
        ],
        dtype=np.bool_,
    )


def mid_stroke_m(motion: Motion) -> float:
    """Mid-stroke height."""
    return 0.5 * (motion.low_m + motion.high_m)


def state_scales(effects: Sequence[StrutEffect]) -> tuple[Array, Flags]:
    """Usual sizes of effects' internal states, and which are fitted at the beginning."""
    scales = [scale for _, name in effects for scale in effect(name).state_scales]
    fitted = [effect(name).fits_state for _, name in effects for _ in effect(name).state_scales]
    return np.array(scales, dtype=np.float64), np.array(fitted, dtype=np.bool_)


def concatenate_blocks(blocks: Sequence[Integers]) -> Integers:
    """Block of each row of several parts, numbered on from one part to the next, shape (m,)."""
    firsts = np.cumsum([0, *(int(part.max()) + 1 for part in blocks[:-1])])
    return np.concatenate([part + first for part, first in zip(blocks, firsts, strict=True)])
