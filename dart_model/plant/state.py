"""Arguments and results of a plant: frozen values."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PlantState(Struct, frozen=True, gc=False):
    """State of a model, made by its `DartPlant`.

    Attributes:
        positions: Joint coordinates, in m or rad, as DART orders them.
        velocities: Joint velocities, in m/s or rad/s.
        internal: Internal states of all effects, strut after strut.
        struts: Height (m) and velocity (m/s; positive is rebound) of every strut at
            these coordinates.
    """

    positions: tuple[float, ...]
    velocities: tuple[float, ...]
    internal: tuple[float, ...]
    t_s: float
    struts: Sequence[tuple[float, float]]


class Loaded(Struct, frozen=True, gc=False):
    """A state under the forces that act from it on.

    Attributes:
        virtual_forces_n: Virtual force in each strut, held until the next state.
        inputs: Input vector, as `dart_model.plant.inputs` defines it.
        forces_n: Spring-damper force of each strut with its effects, without the virtual force.
        accelerations_m_per_s2: Second derivative of each strut's height under all forces.
        position: Coordinates, for the integrator: a float where there is one, else an array.
        velocity: Their rates, likewise.
        drive: Inputs, likewise: a float where there is one.
        acceleration: Their second derivative, likewise.
    """

    state: PlantState
    virtual_forces_n: tuple[float, ...]
    inputs: tuple[float, ...]
    temperature_c: float
    forces_n: list[float]
    accelerations_m_per_s2: list[float]
    position: Any
    velocity: Any
    drive: Any
    acceleration: Any
    internal_rates: list[float]


class Mechanics(NamedTuple):
    """Equations of motion in one configuration, as DART has them.

    ``mass @ acceleration = bias + struts.T @ strut_forces + inputs @ input_vector``, of the n
    coordinates that are free to move.

    Attributes:
        heights_m: Strut heights, shape (struts,).
        struts: Jacobian of the struts, shape (struts, n).
        inputs: Generalised force per unit of each input, shape (n, inputs). That of a moved body's
            acceleration is the inertia that it moves; its position and velocity give none by
            themselves.
        moved: Derivative of the heights by the moved bodies' positions, shape (struts, motions).
        mass: Mass matrix, shape (n, n).
        bias: Other generalised forces: weight, Coriolis and centrifugal forces, springs and
            dampers of the joints, shape (n,).
    """

    heights_m: Array
    struts: Array
    inputs: Array
    moved: Array
    mass: Array
    bias: Array
