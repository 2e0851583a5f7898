"""What drives a model, placed on its skeleton: forces, torques, and bodies that are moved.

The input vector u has, in the order of `ModelSpec.drive`, of a force its value (N), of a torque its
value (N·m), and of a motion position (m), velocity (m/s) and acceleration (m/s²). DART solves the
equations of motion for given accelerations of the moved joints and given forces of all others
(hybrid dynamics).

Reference: Featherstone, "Rigid Body Dynamics Algorithms" (2008), 9.2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import dartpy
import numpy as np
from numpy.typing import NDArray

from dart_model.errors import ModelError
from dart_model.plant.dart_types import DartBody, DartJoint, DartSkeleton
from dart_model.plant.motion_between import coefficients, evaluate
from dart_model.spec import ForceInput, ModelSpec, MotionInput, TorqueInput

Array = NDArray[np.float64]
Integers = NDArray[np.intp]
_Found = TypeVar("_Found")

# dartpy ships no types.
_ACCELERATION = cast("Any", dartpy).dynamics.ActuatorType.ACCELERATION

_PARALLEL = 1e-9
"""Sine of the angle up to which an axis is that of a joint."""


class Moved(NamedTuple):
    """Joint coordinates that are moved as measured: those of the motions, in their order.

    Attributes:
        coordinates: Indices of the coordinates, shape (motions,).
        positions: Index of each motion's position in the input vector; velocity and acceleration
            follow it. Shape (motions,).
        signs: 1 where the coordinate grows with the motion, else -1, shape (motions,).
        each: The three of each motion.
    """

    coordinates: Integers
    positions: Integers
    signs: Array
    each: tuple[tuple[int, int, float], ...]

    def put(self, q: Array, v: Array, inputs: Array) -> None:
        """Write position and velocity of the moved coordinates into `q` and `v`, each (n,)."""
        # One by one: an index array takes five times as long as a number.
        for coordinate, position, sign in self.each:
            q[coordinate] = sign * inputs[position]
            v[coordinate] = sign * inputs[position + 1]

    def between(
        self, begin: Array, end: Array, duration_s: float
    ) -> Callable[[Array, float], None]:
        """Writes the motions at a share of a step into an input vector.

        They are as of `dart_model.plant.motion_between`.
        """
        courses = [
            (part, coefficients(begin[part].tolist(), end[part].tolist(), duration_s))
            for part in (slice(first, first + 3) for first in self.positions.tolist())
        ]

        def write(inputs: Array, share: float) -> None:
            for part, course in courses:
                inputs[part] = evaluate(course, share, duration_s)

        return write


class Inputs:
    """The inputs of a model on its skeleton.

    Args:
        dart: The skeleton; its moved joints are set to be driven by their accelerations.

    Raises:
        ModelError: An input names no body or joint of the skeleton, or a joint that cannot be
            driven so.
    """

    def __init__(self, spec: ModelSpec, dart: DartSkeleton) -> None:
        self._dart = dart
        self.forces: list[tuple[int, DartBody, Array, Array]] = []
        """Column, body, point in its frame (m) and direction of each force."""
        self._fixed: list[tuple[int, int, float]] = []
        """Column, coordinate and value of the entries that are the same everywhere."""
        self.first_force: int | None = None
        """Index of the first force, the applied force of the laws that depend on one."""
        moved: list[tuple[int, int, float]] = []
        size = 0
        for name, item in spec.drive.items():
            where = f"model {spec.name}: inputs.{name}"
            match item:
                case ForceInput():
                    key = "applied_force_body" if spec.inputs is None else f"inputs.{name}.force_on"
                    self._place_force(item, size, f"model {spec.name}: {key}")
                case TorqueInput():
                    self._place_torque(item, size, where)
                case MotionInput():
                    moved.append(self._place_motion(item, size, where))
                    size += 2
            size += 1
        self.size = size
        """Length of the input vector."""
        coordinates = [coordinate for coordinate, _, _ in moved]
        if len(set(coordinates)) < len(coordinates):
            raise ModelError(f"model {spec.name}: inputs: a body is moved twice, expected once")
        self.moved: Moved | None = None
        if moved:
            at, positions, signs = zip(*moved, strict=True)
            self.moved = Moved(
                np.array(at), np.array(positions), np.array(signs, dtype=float), tuple(moved)
            )
        is_free = np.ones(dart.getNumDofs(), dtype=bool)
        is_free[coordinates] = False
        self.free = np.flatnonzero(is_free)
        """Indices of the coordinates that are free to move."""
        if not len(self.free):
            raise ModelError(
                f"model {spec.name}: inputs: every joint is moved, expected one that is free"
            )

    def _place_force(self, item: ForceInput, column: int, where: str) -> None:
        bodies = {body.getName(): body for body in self._dart.getBodyNodes()}
        body = _find(item.force_on, bodies, where)
        axis = np.array(item.axis) / np.linalg.norm(item.axis)
        self.forces.append((column, body, np.array(item.at), axis))
        if self.first_force is None:
            self.first_force = column

    def _place_torque(self, item: TorqueInput, column: int, where: str) -> None:
        joints = {joint.getName(): joint for joint in self._dart.getJoints()}
        joint = _find(item.torque_on, joints, f"{where}.torque_on")
        if joint.getType() != "RevoluteJoint":
            raise ModelError(
                f"{where}.torque_on {item.torque_on!r}: is a {joint.getType()}, expected a "
                "revolute joint"
            )
        self._fixed.append((column, joint.getIndexInSkeleton(0), 1.0))

    def _place_motion(self, item: MotionInput, column: int, where: str) -> tuple[int, int, float]:
        """Coordinate, column and sign of a motion, whose joint is driven from now on."""
        bodies = {body.getName(): body for body in self._dart.getBodyNodes()}
        joint = _find(item.motion_of, bodies, f"{where}.motion_of").getParentJoint()
        sign = _direction(item, joint, f"{where}.motion_of {item.motion_of!r}")
        coordinate = joint.getIndexInSkeleton(0)
        joint.setActuatorType(_ACCELERATION)
        self._fixed.append((column + 2, coordinate, sign))
        return coordinate, column, sign

    def columns(self) -> Array:
        """Generalised force per unit of each input where DART is now, shape (n, inputs).

        In the row of a moved coordinate it is the acceleration per unit.
        """
        columns = np.zeros((self._dart.getNumDofs(), self.size))
        for index, body, at, axis in self.forces:
            jacobian = self._dart.getLinearJacobian(body, at)
            columns[self.free, index] = (axis @ jacobian)[self.free]
        for index, coordinate, value in self._fixed:
            columns[coordinate, index] = value
        return columns


def _find(name: str, choices: dict[str, _Found], where: str) -> _Found:
    if name not in choices:
        raise ModelError(f"{where} {name!r}: expected one of {', '.join(choices)}")
    return choices[name]


def _direction(item: MotionInput, joint: DartJoint, where: str) -> float:
    """1 where the coordinate of a joint grows with a motion, -1 where it falls."""
    if joint.getType() != "PrismaticJoint":
        raise ModelError(
            f"{where}: its joint is a {joint.getType()}, expected a prismatic one: a body that "
            "moves in several directions is a chain of bodies with one each"
        )
    own = joint.getTransformFromParentBodyNode().matrix()[:3, :3] @ joint.getAxis()
    axis = np.array(item.axis) / np.linalg.norm(item.axis)
    if np.linalg.norm(np.cross(own, axis)) > _PARALLEL:
        raise ModelError(
            f"{where}: axis {list(item.axis)}, expected that of its joint, {own.tolist()}"
        )
    return 1.0 if float(own @ axis) > 0.0 else -1.0
