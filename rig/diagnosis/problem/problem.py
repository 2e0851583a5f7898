"""What a model held against recordings is, for whatever kind of bench.

A problem gives the whitened residual of a candidate and, for the screening of laws, the same
regression along the measured motion. Whoever searches knows nothing else of a bench.

References:
    Ljung, System Identification (1999), 7.2 and 9.4, output error and its covariance.
    Young, Recursive Estimation and Time-Series Analysis (2011), 8, for equation errors that pass
    through the model's own dynamics.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.law import Bench, Motion
from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.compiled import Slots, slots
from rig.diagnosis.problem.mechanism import Readers

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Placed = tuple[int, str]
"""Index of a strut, and the name of an effect in it."""

Kind = Literal["mass", "stiffness", "damping", "preload", "gain", "free_length"]


class LinearParameter(NamedTuple):
    """A parameter of the linear part, searched as its change against the nominal model.

    Attributes:
        strut: Index of the strut.
        kind: What it is. Stiffness and preload are taken about mid-stroke; the free length is that
            from which laws are taken, its share in the linear spring's force counts as preload.
        nominal: As the model file has it.
        deviation: Standard deviation of the prior on its change.
        least: Lowest change; mass stays positive, no spring or damper turns negative.
    """

    strut: int
    kind: Kind
    nominal: float
    deviation: float
    least: float


class Existing(NamedTuple):
    """An effect that the nominal model has.

    Attributes:
        strut: Index of the strut.
        name: Name of the effect.
        values: Its parameters.
        free: Whether it is refitted along: linear ones, a table, and what does not act on these
            recordings are not.
    """

    strut: int
    name: str
    values: tuple[float, ...]
    free: bool


class Candidate(NamedTuple):
    """Effects under test.

    Attributes:
        kept: Which of the nominal model's effects stay, by index.
        new: Effects beside them.
    """

    kept: tuple[int, ...]
    new: tuple[Placed, ...]

    def added(self, *placed: Placed) -> "Candidate":
        """The candidate with further effects, in one order whatever way they were found."""
        return self._replace(new=tuple(sorted({*self.new, *placed})))

    def without(self, placed: Placed) -> "Candidate":
        """The candidate less one effect."""
        return self._replace(new=tuple(other for other in self.new if other != placed))


class Parts(NamedTuple):
    """All that a model's answer depends on.

    Attributes:
        linear: Changes of the linear parameters, shape (L,).
        effects: Parameters of all effects, existing ones first, one after another, shape (P,).
        starts: Initial vector of each recording: of a free run coordinates, velocities and the
            internal states of all effects; of a prescribed motion the latter alone.
    """

    linear: Array
    effects: Array
    starts: tuple[Array, ...]


class Track(NamedTuple):
    """A motion on a grid, for laws that are evaluated along it.

    Attributes:
        t_s: Times, shape (N,).
        heights_m: Heights, shape (struts, N).
        velocities_m_per_s: Their rates, shape (struts, N).
        applied_n: Applied force, shape (N,); zero where there is none.
        temperature_c: Temperature, shape (N,).
    """

    t_s: Array
    heights_m: Array
    velocities_m_per_s: Array
    applied_n: Array
    temperature_c: Array

    @classmethod
    def of_columns(
        cls,
        t_s: Array,
        heights_m: Array,
        velocities_m_per_s: Array,
        applied_n: Array,
        temperature_c: Array,
    ) -> "Track":
        """A motion whose heights and velocities come as columns, shape (N, struts)."""
        rows = t_s, heights_m.T, velocities_m_per_s.T, applied_n, temperature_c
        return cls(*(np.ascontiguousarray(row) for row in rows))

    def cut(self, nodes: slice) -> "Track":
        """The motion at some of the nodes."""
        return Track(*(np.ascontiguousarray(part[..., nodes]) for part in self))


class Segment(NamedTuple):
    """A recording or a part of one in the regression along the motion.

    Attributes:
        track: The measured motion, smoothed.
        reference: The motion along which the reference's laws acted.
        lead: Both motions over the whole recording, of which this is a part, for laws that remember
            where they have been; None where this is all of it.
        respond: What a force (N,) in a strut adds to the whitened answer, shape (m,).
        target: Whitened answer that the reference leaves over, shape (m,).
        linear: Whitened answers to a unit change of each linear parameter, shape (m, L).
        initial: Whitened answers to initial states, shape (m, c).
        blocks: Block of each row, counted within it, shape (m,).
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
        name: Name of the recording.
        track: The smoothed motion.
        force_n: The force in each strut, shape (struts, N); NaN where it is not known.
        deviation_n: Its standard deviation, shape (struts, N).
    """

    name: str
    track: Track
    force_n: Array
    deviation_n: Array


@dataclass(frozen=True, eq=False)
class Problem(ABC):
    """A model held against recordings.

    Attributes:
        bench: Kind of bench.
        spec: The nominal model.
        linear: Parameters of the linear part.
        existing: Effects of the nominal model.
        motions: What each strut did on the recordings that are learnt from.
        block_s: Length of the blocks of cross-validation.
        read: DART with the nominal model.
    """

    bench: ClassVar[Bench]
    spec: ModelSpec
    linear: tuple[LinearParameter, ...]
    existing: tuple[Existing, ...]
    motions: tuple[Motion, ...]
    block_s: float
    read: Readers

    @property
    @abstractmethod
    def recordings(self) -> int:
        """Number of recordings."""

    @abstractmethod
    def blocks(self, k: int) -> Integers:
        """Block of each row of a recording's residual, counted within it."""

    @abstractmethod
    def residual(self, k: int, candidate: Candidate, parts: Parts) -> Array | None:
        """Whitened residual of a recording, or None where the model runs away."""

    @abstractmethod
    def floor_level(self, candidate: Candidate, parts: Parts) -> float:
        """Mean square of a right model's residual: noise of the sensors and the applied force."""

    @abstractmethod
    def start(self, k: int, candidate: Candidate) -> Array:
        """First guess of a recording's initial vector."""

    @abstractmethod
    def start_scales(self, candidate: Candidate) -> tuple[Array, Flags]:
        """Usual sizes of an initial vector's entries, and which of them are fitted."""

    @abstractmethod
    def residual_forces(self, k: int, candidate: Candidate, parts: Parts) -> ResidualForces | None:
        """The residual force of a recording, or None where the model runs away."""

    @abstractmethod
    def states(self, k: int, candidate: Candidate, parts: Parts) -> Array:
        """Internal states at the beginning of a recording."""

    @abstractmethod
    def fitted(self, k: int) -> Flags:
        """Nodes of a recording that take part in fits, shape (N,)."""

    @abstractmethod
    def cut(self, pieces: Sequence[tuple[int, slice]]) -> Self:
        """The same of pieces of recordings, each given by its recording's index and its nodes.

        Internal states begin anew with each piece: those that add up over a recording are wrong.
        """

    @abstractmethod
    def segments(
        self, candidate: Candidate, parts: Parts, most_samples: int, most_thinned: int
    ) -> tuple[Segment, ...]:
        """The regression along the motion about a model: its free run, or its force.

        Of longer recordings it takes one node of `most_thinned` at least, and where that leaves too
        many, parts of them.
        """


def placed(problem: Problem, candidate: Candidate) -> tuple[Placed, ...]:
    """All effects of a candidate, existing ones first."""
    kept = ((problem.existing[i].strut, problem.existing[i].name) for i in candidate.kept)
    return (*kept, *candidate.new)


def slots_of(problem: Problem, candidate: Candidate) -> Slots:
    """All effects of a candidate as the compiled loops read them."""
    return slots(placed(problem, candidate))


def nominal(problem: Problem) -> Candidate:
    """The nominal model."""
    return Candidate(tuple(range(len(problem.existing))), ())


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
            row[4] += change * (middle_m(problem.motions[parameter.strut]) - row[0])
        elif parameter.kind == "damping":
            row[2] += change
        elif parameter.kind == "preload":
            row[4] += change
    for parameter, change in zip(problem.linear, linear, strict=True):
        if parameter.kind == "free_length":
            constants[parameter.strut, 0] += change
            constants[parameter.strut, 4] -= constants[parameter.strut, 1] * change
    return constants


def free_beside(problem: Problem, candidate: Candidate) -> Flags:
    """Linear parameters that are free beside a candidate's laws, shape (L,).

    The gain of the applied force is degenerate with all else, and has a turn of its own. The free
    length is seen only where a law is taken from it.
    """
    seen = {strut for strut, name in placed(problem, candidate) if effect(name).about_free_length}
    return np.array(
        [p.kind != "gain" and (p.kind != "free_length" or p.strut in seen) for p in problem.linear],
        dtype=np.bool_,
    )


def middle_m(motion: Motion) -> float:
    """Mid-stroke."""
    return 0.5 * (motion.low_m + motion.high_m)


def state_scales(candidate_effects: Sequence[Placed]) -> tuple[Array, Flags]:
    """Usual sizes of effects' internal states, and which are fitted at the beginning."""
    scales = [scale for _, name in candidate_effects for scale in effect(name).state_scales]
    fitted = [
        effect(name).fits_state for _, name in candidate_effects for _ in effect(name).state_scales
    ]
    return np.array(scales, dtype=np.float64), np.array(fitted, dtype=np.bool_)


def numbered_on(blocks: Sequence[Integers]) -> Integers:
    """Blocks of several parts as those of all, one part after another."""
    firsts = np.cumsum([0, *(int(part.max()) + 1 for part in blocks[:-1])])
    return np.concatenate([part + first for part, first in zip(blocks, firsts, strict=True)])


def block_numbers(t_s: Array, length_s: float) -> Integers:
    """Blocks of equal length over the times of a recording, at least two."""
    count = max(2, round(float(t_s[-1] - t_s[0]) / length_s))
    share = (t_s - t_s[0]) / float(t_s[-1] - t_s[0])
    return np.minimum((share * count).astype(np.int64), count - 1)
