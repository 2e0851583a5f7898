"""What a model that runs in step with a bench must be able to do, whatever simulates it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from dart_model.virtual_sensors import VirtualSensor


class ModelState(Protocol):
    """State of a model, made by its plant and frozen."""

    @property
    def struts(self) -> Sequence[tuple[float, float]]:
        """Height (m) and velocity (m/s) of each strut."""
        ...


StateT = TypeVar("StateT", bound=ModelState)
StateT_co = TypeVar("StateT_co", bound=ModelState, covariant=True)


class LoadedModel(Protocol[StateT_co]):
    """A state of a model under the forces that act from it on; frozen."""

    @property
    def state(self) -> StateT_co:
        """The state."""
        ...

    @property
    def forces_n(self) -> Sequence[float]:
        """Spring-damper force of each strut, without the virtual force."""
        ...

    @property
    def accelerations_m_per_s2(self) -> Sequence[float]:
        """Second derivative of each strut's height."""
        ...

    @property
    def inputs(self) -> Sequence[float]:
        """Input vector: forces (N), torques (N·m), and of motions position, velocity, acceleration.

        Its order is that of `ModelSpec.drive`.
        """
        ...

    @property
    def temperature_c(self) -> float:
        """Damper temperature."""
        ...


LoadedT = TypeVar("LoadedT", bound=LoadedModel[ModelState])


class MotionGains(NamedTuple):
    """How sensors of motions change: positions and angles as given, rates by rates.

    Attributes:
        by_heights: By the heights of some struts, shape (sensors, struts); NaN where they do not
            determine a sensor, and of sensors of forces.
        by_motions: By each moved body while these heights stay, shape (sensors, motions).
        directly: By each moved body that moves too fast for all else, which stays by its inertia,
            shape (sensors, motions).
    """

    by_heights: NDArray[np.float64]
    by_motions: NDArray[np.float64]
    directly: NDArray[np.float64]


LoadedT_contra = TypeVar("LoadedT_contra", bound=LoadedModel[ModelState], contravariant=True)


class SensorReader(Protocol[LoadedT_contra]):
    """Virtual sensors of bodies and joints in a model."""

    def read(self, loaded: LoadedT_contra, residual_forces_n: Sequence[float]) -> list[float]:
        """What they show, in SI, where struts act with their laws and these forces."""
        ...

    def force_gains(self, loaded: LoadedT_contra) -> list[list[float]]:
        """Change of each sensor by a newton in each strut, shape (sensors, struts)."""
        ...

    @property
    def has_constant_gains(self) -> bool:
        """Whether the gains are the same in every state."""
        ...

    def motion_gains(self, loaded: LoadedT_contra, struts: Sequence[int]) -> MotionGains:
        """Change of sensors of motions by the heights of some struts, and by each moved body."""
        ...


AnySensorReader = SensorReader[Any]
"""A reader of whatever engine."""


class Plant(Protocol[StateT, LoadedT]):
    """A model that runs in step with a bench. Its answers depend on its arguments alone."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        ...

    @property
    def inputs(self) -> int:
        """Length of the input vector."""
        ...

    @property
    def internal_states(self) -> int:
        """Number of internal states of all effects, the last of a state's `numbers`."""
        ...

    @property
    def is_constant(self) -> bool:
        """Whether mass matrix and Jacobians of the struts are the same in every state."""
        ...

    def init(
        self,
        heights_m: Sequence[float],
        velocities_m_per_s: Sequence[float] | None = None,
        t_s: float = 0.0,
        inputs: Sequence[float] | None = None,
    ) -> StateT:
        """State with given strut heights, at rest unless velocities are given.

        Bodies that are moved are where the inputs have them; without inputs they are at zero.
        """
        ...

    def load(
        self,
        state: StateT,
        virtual_forces_n: Sequence[float],
        inputs: Sequence[float],
        temperature_c: float,
    ) -> LoadedT:
        """The state with forces on it; virtual forces are constant from it on."""
        ...

    def step(self, loaded: LoadedT, dt_s: float, inputs_end: Sequence[float]) -> StateT:
        """State after `dt_s`; forces of the inputs are linear in between."""
        ...

    def slopes(
        self, state: StateT, inputs: Sequence[float], temperature_c: float
    ) -> Sequence[tuple[float, float]] | None:
        """Stiffness (N/m) and damping (N·s/m) of each strut's law about a state.

        None where they are the same in every state, or not known.
        """
        ...

    def virtual_sensors(self, sensors: Mapping[str, VirtualSensor]) -> SensorReader[LoadedT]:
        """What reads virtual sensors of bodies and joints.

        Raises:
            ModelError: The model has not what one reads.
        """
        ...

    def numbers(self, state: StateT) -> Sequence[float]:
        """A state as numbers, for differences of a step."""
        ...

    def state_of(
        self, numbers: Sequence[float], t_s: float = 0.0, inputs: Sequence[float] | None = None
    ) -> StateT:
        """The state that `numbers` returned; bodies that are moved are at zero without inputs."""
        ...


AnyPlant = Plant[Any, Any]
"""A plant of whatever engine: its states come from it alone and go back to it alone."""
