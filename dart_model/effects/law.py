"""What an effect is: a strut force that the linear spring-damper law does not have.

An effect is defined in one place: the law, its internal states, where a search for its parameters
begins and ends, what it degenerates to, where it can be observed, and its wording in reports.
"""

from collections.abc import Callable, Iterable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple, TypeVar

_Value = TypeVar("_Value")
Floats = Sequence[float]
Writable = MutableSequence[float]
Rates = tuple[float, ...]

Force = Callable[..., float]
"""Force in N, positive when it pushes the strut's bodies apart, over named arguments: see
`dart_model.effects.calling` for the names."""

Rate = Callable[..., float | Rates | None]
"""Time derivative of the internal state, or of all of them in their order, over the same arguments;
a law whose states are a group writes them into its argument `rates`."""

Bench = Literal["force_given", "motion_given"]
"""Force given, residual in the height (free run); or motion given, residual in the force (dyno)."""


class Motion(NamedTuple):
    """What a strut did on the recordings: that from which starts and bounds of a law follow.

    Attributes:
        speed_m_per_s: Root mean square of the velocity.
        top_speed_m_per_s: Largest velocity.
        least_stroke_m: Stroke of the recording with the smallest one.
        duration_s: Length of the longest recording.
        step_s: Usual time between samples.
        mass_kg: Mass that the strut moves.
        force_n: Root mean square of the force that the linear part leaves over.
        temperatures_c: Lowest and highest temperature; equal where none was measured.
        tones: Frequency (Hz) and phase (rad) of the strongest lines of that force.
    """

    low_m: float
    high_m: float
    speed_m_per_s: float
    top_speed_m_per_s: float
    least_stroke_m: float
    duration_s: float
    step_s: float
    free_length_m: float
    stiffness_n_per_m: float
    damping_n_s_per_m: float
    mass_kg: float
    force_n: float
    temperatures_c: tuple[float, float]
    tones: tuple[tuple[float, float], ...]

    @property
    def stroke_m(self) -> float:
        """Highest less lowest height."""
        return self.high_m - self.low_m

    def heights_m(self, *shares: float) -> list[float]:
        """Heights at shares of the stroke."""
        return [self.low_m + share * self.stroke_m for share in shares]


Start = tuple[float, ...]
"""All parameters of a law. Those in `Effect.scaled` stand for a force of arbitrary size, which a
linear fit sets."""

Bounds = Mapping[str, tuple[float, float]]
"""Parameter -> lowest and highest value within a search; what is not named keeps its own bounds."""


def no_starts(_: Motion) -> list[Start]:
    """No start: the effect is proposed by no search."""
    return []


def no_bounds(_: Motion) -> Bounds:
    """No bounds by the motion: the parameters keep those that they are declared with."""
    return MappingProxyType({})


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        name: Key in the model file, with its unit.
        unit: Unit as printed in reports; empty if dimensionless.
        low: Smallest value that makes physical sense; a model file below it is refused.
        high: Largest value that makes physical sense; a model file above it is refused.
        group: Argument by which the law takes this parameter together with its neighbours of the
            same group, as a row; empty if it is a separate argument.
    """

    name: str
    unit: str
    low: float
    high: float
    meaning: str
    group: str = ""


class State(NamedTuple):
    """One internal state of an effect; all start at zero in a live run.

    Attributes:
        name: Argument of the law, with its unit.
        group: Argument by which the law takes this state together with its neighbours of the same
            group, as a row; empty if it is a separate argument.
    """

    name: str
    scale: float
    group: str = ""


@dataclass(frozen=True)
class Effect:
    """An effect that a model can be given and that a diagnosis can find.

    A law is written once, as a formula over named arguments in plain scalar arithmetic (`math`, no
    numpy), so that the plant can call it tick by tick, the diagnosis can compile it for a whole
    recording, and an FMU can hold it as C.

    Attributes:
        family: Family as in the diagnosis, e.g. ``friction``.
        words: The effect as a phrase with its article, the law in brackets.
        parameters: Parameters in the order in which arrays of values hold them.
        force: The law.
        excitation: What a recording must contain for the effect to be seen; it continues the phrase
            "a run with".
        rate: Derivative of the internal state, or None for a law without one.
        states: Internal states in the order of `rate`.
        fits_state: Whether the state at the beginning of a recording is fitted: states that fade
            or are overwritten by the motion are, those that add up from the beginning are not.
        adds_mass: The first parameter is a mass in kg which is added to the strut's second body
            (DART carries it, with its weight); `force` is what acts beyond that.
        linear: Part of every model or of every measurement: a search corrects it and does not
            propose it.
        scaled: Indices of the parameters which, multiplied together by a factor, multiply the
            force by it; empty where there are none.
        starts: Where a search begins, for a motion; empty where the motion cannot show it.
        bounds: Where a search ends, for a motion.
        simpler: Effects to which this one degenerates at the ends of its parameters.
        benches: Kinds of bench on which it can be seen.
        shown: Parameters that a sentence about it states.
        edges: Of a law that changes at two heights, the lower and the upper one, each by the
            weights of all parameters in it; empty for others.
        about_free_length: Whether another free length changes its force by more than a linear
            spring and damper could.
    """

    name: str
    family: str
    words: str
    parameters: tuple[Parameter, ...]
    force: Force
    excitation: str
    reference: str
    rate: Rate | None = None
    states: tuple[State, ...] = ()
    fits_state: bool = False
    adds_mass: bool = False
    linear: bool = False
    scaled: tuple[int, ...] = (0,)
    starts: Callable[[Motion], list[Start]] = no_starts
    bounds: Callable[[Motion], Bounds] = no_bounds
    simpler: tuple[str, ...] = ()
    benches: tuple[Bench, ...] = ("force_given", "motion_given")
    shown: tuple[str, ...] = ()
    edges: tuple[tuple[float, ...], ...] = ()
    about_free_length: bool = False

    @property
    def state_size(self) -> int:
        """Number of internal states."""
        return len(self.states)

    @property
    def state_scales(self) -> tuple[float, ...]:
        """Usual size of each internal state."""
        return tuple(state.scale for state in self.states)

    def named(self, values: Iterable[_Value]) -> dict[str, _Value]:
        """What belongs to each parameter, in their order, by the parameter's name."""
        names = (parameter.name for parameter in self.parameters)
        return dict(zip(names, values, strict=True))
