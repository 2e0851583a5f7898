"""The acceleration in a state under given forces, by DART.

A model with one coordinate, the usual bench, is computed with floats and any other with arrays. The
two classes are the whole difference: the formulas around them hold for both.
"""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from dart_model.plant.loops import Loops
from dart_model.plant.skeleton import Skeleton

Array = NDArray[np.float64]

Value = TypeVar("Value", float, Array)
"""One number a coordinate: a float where there is one coordinate, else an array of shape (n,)."""


class Backend(Protocol[Value]):
    """Joint coordinates and their dynamics."""

    def value(self, numbers: Sequence[float], /) -> Value:
        """One number a coordinate, from a sequence."""
        ...

    def numbers(self, value: Value) -> tuple[float, ...]:
        """The same as a tuple."""
        ...

    def dot(self, row: Value, value: Value, /) -> float:
        """Product of a row of a Jacobian and a value."""
        ...

    def move(self, q: Value, v: Value, h: float, /) -> Value:
        """Coordinates after `h` seconds at given rates."""
        ...

    def acceleration(self, q: Value, v: Value, force: Value) -> Value:
        """Second derivative of the coordinates under generalised forces, in m/s² or rad/s².

        Of a moved coordinate, `force` has the acceleration.
        """
        ...

    def drive(self, columns: Value, inputs: Value, /) -> Value:
        """Generalised force of inputs, by their columns as of `Jacobians.inputs`."""
        ...

    def columns(self, columns: Array) -> Value:
        """Columns as `drive` reads them, from an array of shape (n, inputs)."""
        ...

    def motions_between(
        self, begin: Value, end: Value, duration_s: float
    ) -> Callable[[Value, float], None] | None:
        """Writes what is moved, at a share of a step, into inputs; None where nothing is moved."""
        ...

    def put_moved(self, q: Value, v: Value, inputs: Value) -> None:
        """Write what is moved into coordinates and rates."""
        ...

    def applied_force_n(self, inputs: Value, /) -> float:
        """Applied force of the laws that depend on one: the first force of the inputs."""
        ...

    def closed(self, q: Value, v: Value) -> tuple[Value, Value]:
        """Coordinates and rates without what a step has left open of loops."""
        ...


_SAMPLE_FORCES_N = (0.0, 1e-3, -0.7, 37.3, -4100.0)
"""A difference in the last bit may hide behind a large force."""


class OneCoordinate:
    """The only coordinate of a skeleton and its only input, as floats."""

    dot = staticmethod(operator.mul)
    drive = staticmethod(operator.mul)
    value = staticmethod(operator.itemgetter(0))
    applied_force_n = staticmethod(float)

    def __init__(self, skeleton: Skeleton) -> None:
        coordinate = skeleton.dart.getDof(0)
        self._put_position: Callable[[float], None] = coordinate.setPosition
        self._put_velocity: Callable[[float], None] = coordinate.setVelocity
        self._put_force: Callable[[float], None] = coordinate.setForce
        self._solve: Callable[[], None] = skeleton.dart.computeForwardDynamics
        self._acceleration: Callable[[], float] = coordinate.getAcceleration
        self.acceleration = self._accelerate_from
        if self._depends_on_force_alone():
            self.acceleration = self._accelerate_by

    def numbers(self, value: float) -> tuple[float, ...]:
        return (value,)

    def move(self, q: float, v: float, h: float) -> float:
        return q + h * v

    def columns(self, columns: Array) -> float:
        return float(columns[0, 0])

    def closed(self, q: float, v: float) -> tuple[float, float]:
        return q, v

    def motions_between(self, begin: float, end: float, duration_s: float) -> None:
        """None: its only coordinate is free."""

    def put_moved(self, q: float, v: float, inputs: float) -> None:
        """Nothing: its only coordinate is free."""

    def _accelerate_from(self, q: float, v: float, force: float) -> float:
        self._put_position(q)
        self._put_velocity(v)
        return self._accelerate_by(q, v, force)

    def _accelerate_by(self, q: float, v: float, force: float) -> float:
        del q, v
        self._put_force(force)
        self._solve()
        return self._acceleration()

    def _depends_on_force_alone(self) -> bool:
        """Whether position and velocity make no difference to DART's answer, not even in a bit.

        So it is for a body on a straight guide without springs or damping of DART's own; setting
        its position takes DART as long as the answer itself.
        """
        return all(
            len(
                {
                    self._accelerate_from(0.3 * math.sin(1.7 * k), math.cos(2.3 * k), force_n)
                    for k in range(16)
                }
            )
            == 1
            for force_n in _SAMPLE_FORCES_N
        )


class ManyCoordinates:
    """The coordinates of a skeleton, as an array."""

    def __init__(self, skeleton: Skeleton) -> None:
        # DART's functions for arrays cost as much as six or more of those for one number.
        coordinates = [skeleton.dart.getDof(k) for k in range(skeleton.coordinates)]
        free = skeleton.inputs.free.tolist()
        self._put: list[tuple[Callable[[float], None], ...]] = [
            (item.setPosition, item.setVelocity, item.setForce if k in free else item.setCommand)
            for k, item in enumerate(coordinates)
        ]
        self._moved = skeleton.inputs.moved
        self._first_force = skeleton.inputs.first_force
        self._get: list[Callable[[], float]] = [item.getAcceleration for item in coordinates]
        self._solve: Callable[[], None] = skeleton.dart.computeForwardDynamics
        self.move = skeleton.move

    def value(self, numbers: Sequence[float], /) -> Array:
        return np.array(numbers, dtype=np.float64)

    def numbers(self, value: Array) -> tuple[float, ...]:
        return tuple(value.tolist())

    def dot(self, row: Array, value: Array) -> float:
        return float(row @ value)

    def drive(self, columns: Array, inputs: Array) -> Array:
        return columns @ inputs

    def columns(self, columns: Array) -> Array:
        return columns

    def motions_between(
        self, begin: Array, end: Array, duration_s: float
    ) -> Callable[[Array, float], None] | None:
        if self._moved is None or duration_s == 0.0:
            return None
        return self._moved.between(begin, end, duration_s)

    def put_moved(self, q: Array, v: Array, inputs: Array) -> None:
        if self._moved is not None:
            self._moved.put(q, v, inputs)

    def applied_force_n(self, inputs: Array) -> float:
        return 0.0 if self._first_force is None else float(inputs[self._first_force])

    def closed(self, q: Array, v: Array) -> tuple[Array, Array]:
        return q, v

    def acceleration(self, q: Array, v: Array, force: Array) -> Array:
        numbers = zip(q.tolist(), v.tolist(), force.tolist(), strict=True)
        for puts, values in zip(self._put, numbers, strict=True):
            for put, number in zip(puts, values, strict=True):
                put(number)
        self._solve()
        return np.array([get() for get in self._get])


class LoopedCoordinates(ManyCoordinates):
    """The coordinates of a skeleton whose joints close loops.

    DART accelerates the tree, and the multipliers of the loops' constraints add what they hold.
    """

    def __init__(self, skeleton: Skeleton, loops: Loops) -> None:
        super().__init__(skeleton)
        self._loops = loops

    def closed(self, q: Array, v: Array) -> tuple[Array, Array]:
        return self._loops.project(q, v)

    def acceleration(self, q: Array, v: Array, force: Array) -> Array:
        free = super().acceleration(q, v, force)
        return free + self._loops.multipliers(q)[1]
