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
        forces_n: Spring-damper force of each strut with its effects, without the virtual force.
        accelerations_m_per_s2: Second derivative of each strut's height under all forces.
        position: Coordinates, for the integrator: a float where there is one, else an array.
        velocity: Their rates, likewise.
        acceleration: Their second derivative, likewise.
    """

    state: PlantState
    virtual_forces_n: tuple[float, ...]
    applied_force_n: float
    temperature_c: float
    forces_n: list[float]
    accelerations_m_per_s2: list[float]
    position: Any
    velocity: Any
    acceleration: Any
    internal_rates: list[float]


class Mechanics(NamedTuple):
    """Equations of motion in one configuration, as DART has them.

    ``mass @ acceleration = bias + struts.T @ strut_forces + applied * applied_force``.

    Attributes:
        heights_m: Strut heights, shape (struts,).
        struts: Jacobian of the struts, shape (struts, n).
        applied: Generalised force per newton of applied force, shape (n,).
        mass: Mass matrix, shape (n, n).
        bias: Other generalised forces: weight, Coriolis and centrifugal forces, springs and
            dampers of the joints, shape (n,).
    """

    heights_m: Array
    struts: Array
    applied: Array
    mass: Array
    bias: Array
