"""What an effect is: a strut force the seed's spring-damper law does not have."""

from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass

Floats = Sequence[float]
Writable = MutableSequence[float]

Force = Callable[
    [
        float,  # t_s
        float,  # height_m
        float,  # velocity_m_per_s
        float,  # applied_force_n
        float,  # temperature_c
        Sequence[float],  # state
        Sequence[float],  # parameters, in the order of Effect.parameters
        Sequence[float],  # strut: free length (m), stiffness (N/m), damping (N·s/m), gravity (m/s²)
    ],
    float,
]
"""Force in N, positive when it pushes the strut's bodies apart."""

Rate = Callable[
    [
        float,
        float,
        float,
        float,
        float,
        Sequence[float],
        Sequence[float],
        Sequence[float],
        MutableSequence[float],  # time derivative of the state, written
    ],
    None,
]
"""Same arguments as `Force`, then the derivative of the effect's state, written in place."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        name: Key in the model file, with its unit.
        unit: Unit as printed in reports; empty if dimensionless.
        low: Smallest value that makes physical sense.
        high: Largest value that makes physical sense.
        meaning: One line for the report.
    """

    name: str
    unit: str
    low: float
    high: float
    meaning: str


@dataclass(frozen=True)
class Effect:
    """An effect that a model can be given and that an attribution can find.

    A law is written once, in plain scalar arithmetic (`math`, no numpy), so that the plant can call
    it tick by tick and the attribution can compile the very same function over a whole log.

    Attributes:
        name: Key in the model file.
        family: Family as in the diagnosis, e.g. ``friction``.
        parameters: Parameters in the order in which the law reads them.
        force: The law.
        rate: Derivative of the memory, or None for a law without memory.
        state_size: Number of memory states; they start at zero.
        adds_mass: The first parameter is a mass in kg which is added to the strut's second body
            (DART carries it, with its weight); `force` is what acts beyond that.
        scaled: Indices of the parameters which, multiplied together by a factor, multiply the
            force by it; empty where there are none.
        excitation: What a run must contain for the effect to be seen.
        reference: Literature.
    """

    name: str
    family: str
    parameters: tuple[Parameter, ...]
    force: Force
    excitation: str
    reference: str
    rate: Rate | None = None
    state_size: int = 0
    adds_mass: bool = False
    scaled: tuple[int, ...] = (0,)
