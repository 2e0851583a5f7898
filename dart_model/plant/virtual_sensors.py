"""Any variable of a model in a state: motions of points and bodies, and what joints carry.

A joint carries what its subtree needs beside the forces that act on that: the inertia of the
bodies in it, less their weight, less struts, inputs and joints of loops that act on them from
outside. Struts act along their lines on both ends, whatever directions the joints leave free.

Where all of that is affine in coordinates, rates, accelerations, strut forces and inputs, as of
bodies on straight guides, it is one matrix.

References:
    Featherstone, "Rigid Body Dynamics Algorithms" (2008), 5.3, forces from the leaves to the root.
    Dobrowolski, "Swing-twist decomposition in Clifford algebra" (2015), the angle about an axis.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import expected_name
from dart_model.errors import ModelError
from dart_model.plant.geometry import Geometry
from dart_model.plant.skeleton import Skeleton, build
from dart_model.plant.state import Loaded
from dart_model.protocol import MotionGains
from dart_model.spec import WORLD, ModelSpec
from dart_model.virtual_sensors import VirtualSensor

Array = NDArray[np.float64]

_TURNING = "RevoluteJoint"
_AFFINE = 1e-9
"""Largest difference from an affine reading that is rounding, relative."""
_DETERMINED = 1e-6
"""Share of a sensor's derivative that is rounding, and of the largest singular value below which
heights depend on one another."""


class _Instant(NamedTuple):
    """What acts between DART's bodies where they are.

    Attributes:
        forces_n: Of the struts, shape (struts,).
        inputs: Input vector.
        directions: Along which struts push, shape (struts, 3); empty where no joint is read.
        ends: Lower and upper ends of the struts in m, shape (2, struts, 3); likewise.
        wrenches: Force (N) and torque (N·m) that each loop's joint exerts on its second body at its
            point, in the world's directions, shape (loops, 2, 3); likewise.
    """

    forces_n: Array
    inputs: Array
    directions: Array
    ends: Array
    wrenches: Array


_Reader = Callable[[_Instant], float]


class VirtualSensors:
    """Virtual sensors of bodies and joints on a model's skeleton.

    Args:
        accelerate: Acceleration of the coordinates by a state and the forces in parallel with the
            struts.

    Raises:
        ModelError: A sensor names no body or joint, or one that has not what it reads.
    """

    def __init__(
        self,
        spec: ModelSpec,
        skeleton: Skeleton,
        geometry: Geometry,
        sensors: Mapping[str, VirtualSensor],
        accelerate: Callable[[Loaded, Sequence[float]], Sequence[float]],
    ) -> None:
        self._spec, self._skeleton, self._geometry = spec, skeleton, geometry
        self._accelerate = accelerate
        self._dart = cast("Any", skeleton.dart)
        self._bodies: dict[str, Any] = {body.getName(): body for body in self._dart.getBodyNodes()}
        self._joints: dict[str, Any] = {joint.getName(): joint for joint in self._dart.getJoints()}
        self._gravity = np.array([0.0, 0.0, -spec.gravity_m_per_s2])
        self._reads_joints = any(it.kind in ("reaction_of", "torque_of") for it in sensors.values())
        self._readers = [self._reader(name, sensor) for name, sensor in sensors.items()]
        self._derivatives = [self._derivative(sensor) for sensor in sensors.values()]
        self.affine = self._find_affine()
        """Readings by positions, rates, accelerations, strut forces, inputs, more force in
        parallel with the struts, and one; None where a sensor is curved."""

    def read(self, loaded: Loaded, residual_forces_n: Sequence[float]) -> list[float]:
        """What the sensors show in a state, in SI.

        The model is where `loaded` has it; its struts act with their laws and residual forces.
        """
        forces = [law + more for law, more in zip(loaded.forces_n, residual_forces_n, strict=True)]
        state = loaded.state
        if self.affine is not None:
            matrix = self.affine
            change = [
                a - b for a, b in zip(residual_forces_n, loaded.virtual_forces_n, strict=True)
            ]
            # A float where there is one coordinate.
            a = loaded.acceleration
            accelerations: Sequence[float] = (a,) if isinstance(a, float) else a.tolist()
            numbers = [
                *state.positions,
                *state.velocities,
                *accelerations,
                *forces,
                *loaded.inputs,
                *change,
                1.0,
            ]
            values: list[float] = matrix.dot(numbers).tolist()
            return values
        acceleration = self._accelerate(loaded, residual_forces_n)
        motion = state.positions, state.velocities, acceleration
        q, v, a = (np.array(part) for part in motion)
        return self._read(q, v, a, np.array(forces), np.array(loaded.inputs))

    def force_gains(self, loaded: Loaded) -> list[list[float]]:
        """Change of each sensor by a newton in each strut, shape (sensors, struts).

        Where they depend on the configuration, they are those of `loaded`.
        """
        struts = len(self._spec.struts)
        virtual = list(loaded.virtual_forces_n)
        first = self.read(loaded, virtual)
        columns: list[list[float]] = []
        for strut in range(struts):
            more = [force + (i == strut) for i, force in enumerate(virtual)]
            changed = zip(self.read(loaded, more), first, strict=True)
            columns.append([after - before for after, before in changed])
        return [list(row) for row in zip(*columns, strict=True)]

    @property
    def has_constant_gains(self) -> bool:
        """Whether the gains are the same in every state."""
        return self.affine is not None

    def motion_gains(self, loaded: Loaded, struts: Sequence[int]) -> MotionGains:
        """Change of sensors of motions by the heights of some struts, and by each moved body.

        Where joints turn, it is that of `loaded`.
        """
        q, free, loops = np.array(loaded.state.positions), self._skeleton.free, self._skeleton.loops
        spread = np.eye(len(q)) if loops is None else loops.spread(q)
        seen = self._geometry.at(q).struts[list(struts)] @ spread
        self._dart.setPositions(q)
        mass = spread.T @ np.array(self._dart.getMassMatrix()) @ spread
        # One by one: the numbers of one sensor are the same whatever others there are.
        rows = np.array([derivative() @ spread for derivative in self._derivatives])
        inverse = np.linalg.pinv(seen[:, free], rcond=_DETERMINED)
        by_heights = np.array([row @ inverse for row in rows[:, free]])
        left = rows - np.array([row @ seen for row in by_heights])
        rest, size = (np.linalg.norm(it[:, free], axis=1) for it in (left, rows))
        by_heights[~(rest <= _DETERMINED * size)] = np.nan
        moved = self._skeleton.inputs.moved
        if moved is None:
            return MotionGains(by_heights, rows[:, :0], rows[:, :0])
        at = moved.coordinates
        # What is free stays where it is by its inertia.
        jolt = np.linalg.solve(mass[np.ix_(free, free)], mass[np.ix_(free, at)])
        directly = rows[:, at] - np.array([row @ jolt for row in rows[:, free]])
        return MotionGains(by_heights, left[:, at] * moved.signs, directly * moved.signs)

    def _read(self, q: Array, v: Array, a: Array, forces_n: Array, inputs: Array) -> list[float]:
        dart = self._dart
        directions, ends, wrenches = q[:0], q[:0], q[:0]
        if self._reads_joints:
            directions, ends = self._geometry.lines(q)
            wrenches = self._loop_wrenches(q, v, forces_n, inputs)
        dart.setPositions(q)
        dart.setVelocities(v)
        dart.setAccelerations(a)
        now = _Instant(forces_n, inputs, directions, ends, wrenches)
        return [reader(now) for reader in self._readers]

    def _loop_wrenches(self, q: Array, v: Array, forces_n: Array, inputs: Array) -> Array:
        """What the joints of loops exert on their second bodies, shape (loops, 2, 3)."""
        loops = self._skeleton.loops
        if loops is None:
            return np.zeros((0, 2, 3))
        here = self._geometry.at(q)
        force = here.inputs @ inputs + (forces_n @ here.struts) * self._geometry.is_free
        self._dart.setPositions(q)
        self._dart.setVelocities(v)
        # Of a moved coordinate it is the acceleration, a command to DART. A command to any other
        # coordinate would be its force, so that the forces come last.
        self._dart.setCommands(force)
        self._dart.setForces(force)
        self._dart.computeForwardDynamics()
        multipliers, _ = loops.multipliers(q)
        return loops.wrenches(multipliers)

    def _find_affine(self) -> Array | None:
        """Matrix of all numbers, of more force in parallel with the struts, and of one.

        None where a sensor is curved.
        """
        if self._geometry.constant is None:
            return None
        n, struts = self._skeleton.coordinates, len(self._spec.struts)
        sizes = [n, n, n, struts, self._skeleton.inputs.size]
        ends = np.cumsum(sizes)[:-1]

        def at(numbers: Array) -> Array:
            q, v, a, forces_n, inputs = np.split(numbers, ends)
            return np.array(self._read(q, v, a, forces_n, inputs))

        size = sum(sizes)
        offset = at(np.zeros(size))
        matrix = np.column_stack([at(column) - offset for column in np.eye(size)])
        rng = np.random.default_rng(0)
        for _ in range(3):
            numbers = rng.standard_normal(size)
            expected = matrix @ numbers + offset
            if not np.allclose(at(numbers), expected, rtol=_AFFINE, atol=_AFFINE):
                return None
        accelerations = slice(2 * n, 3 * n)
        by_more_force = matrix[:, accelerations] @ self._response()
        return np.ascontiguousarray(np.column_stack([matrix, by_more_force, offset]))

    def _response(self) -> Array:
        """Acceleration of the coordinates per newton in parallel with each strut, (n, struts)."""
        n, free = self._skeleton.coordinates, self._skeleton.inputs.free
        dart, zeros = self._dart, np.zeros(self._skeleton.coordinates)
        rows = self._geometry.at(zeros).struts
        dart.setPositions(zeros)
        response = np.zeros((n, len(rows)))
        mass = np.array(dart.getMassMatrix())[np.ix_(free, free)]
        response[free] = np.linalg.solve(mass, rows[:, free].T)
        return response

    # --- one sensor -------------------------------------------------------------------------------

    def _reader(self, name: str, sensor: VirtualSensor) -> _Reader:
        """What reads a sensor where DART's bodies are, by strut forces and inputs."""
        where = f"virtual_sensors.{name}.{sensor.kind}"
        axis = np.array(sensor.axis) / np.linalg.norm(sensor.axis)
        of_bodies = {
            "position_of": self._position,
            "velocity_of": self._velocity,
            "acceleration_of": self._acceleration,
            "angle_of": self._angle,
            "rate_of": self._rate,
        }
        if sensor.kind in of_bodies:
            body = _find(sensor.target, self._bodies, where)
            return of_bodies[sensor.kind](body, np.array(sensor.at), axis)
        joint = _find(sensor.target, self._joints, where)
        match sensor.kind:
            case "reaction_of":
                return self._reaction(joint, axis)
            case "torque_of":
                return self._torque(joint, axis)
            case kind:
                return self._coordinate(joint, where, is_rate=kind == "speed_of")

    def _position(self, body: Any, at: Array, axis: Array) -> _Reader:
        point = np.append(at, 1.0)
        return lambda _: float(axis @ (body.getWorldTransform().matrix() @ point)[:3])

    def _velocity(self, body: Any, at: Array, axis: Array) -> _Reader:
        return lambda _: float(axis @ body.getLinearVelocity(at))

    def _acceleration(self, body: Any, at: Array, axis: Array) -> _Reader:
        return lambda _: float(axis @ body.getLinearAcceleration(at))

    def _angle(self, body: Any, _at: Array, axis: Array) -> _Reader:
        start = self._rest_rotation(body)

        def angle(_: _Instant) -> float:
            turn = body.getWorldTransform().matrix()[:3, :3] @ start.T
            # Twice the sine times the axis of the turn, and twice its cosine.
            sines = np.array(
                [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
            )
            return 2.0 * math.atan2(float(axis @ sines), 1.0 + float(np.trace(turn)))

        return angle

    def _rest_rotation(self, body: Any) -> Array:
        """Orientation of a body with all coordinates at zero, from which angles are counted."""
        self._dart.setPositions(np.zeros(self._skeleton.coordinates))
        return np.array(body.getWorldTransform().matrix()[:3, :3])

    def _rate(self, body: Any, _at: Array, axis: Array) -> _Reader:
        return lambda _: float(axis @ body.getAngularVelocity())

    def _coordinate(self, joint: Any, where: str, *, is_rate: bool) -> _Reader:
        if joint.getNumDofs() != 1:
            raise ModelError(
                f"{where} {joint.getName()!r}: a {joint.getType()} with {joint.getNumDofs()} "
                "coordinates, expected a joint with one"
            )
        coordinate = self._dart.getDof(joint.getIndexInSkeleton(0))
        read = coordinate.getVelocity if is_rate else coordinate.getPosition
        return lambda _: float(read())

    def _derivative(self, sensor: VirtualSensor) -> Callable[[], Array]:
        """What gives the derivative of a sensor of a motion by the coordinates, shape (n,)."""
        axis = np.array(sensor.axis) / np.linalg.norm(sensor.axis)
        unknown = np.full(self._skeleton.coordinates, np.nan)
        match sensor.kind:
            case "position_of" | "velocity_of":
                body, at = self._bodies[sensor.target], np.array(sensor.at)
                return lambda: axis @ self._dart.getLinearJacobian(body, at)
            case "angle_of" | "rate_of":
                body = self._bodies[sensor.target]
                return lambda: axis @ self._dart.getAngularJacobian(body)
            case "coordinate_of" | "speed_of":
                own = np.zeros_like(unknown)
                own[self._joints[sensor.target].getIndexInSkeleton(0)] = 1.0
                return lambda: own
            case _:
                return lambda: unknown

    # --- what joints carry ------------------------------------------------------------------------

    def _reaction(self, joint: Any, axis: Array) -> _Reader:
        bodies = self._subtree(joint)
        inputs = self._inputs_on(bodies)
        signs = self._strut_signs(bodies)
        loops = self._loops_on(bodies)

        def reaction(now: _Instant) -> float:
            total = 0.0
            for body in bodies:
                excess = body.getCOMLinearAcceleration() - self._gravity
                total += body.getMass() * float(axis @ excess)
            total -= float((signs.sum(axis=0) * now.forces_n) @ (now.directions @ axis))
            for column, _, _, direction in inputs:
                total -= float(now.inputs[column]) * float(axis @ direction)
            for k, sign, _ in loops:
                total -= sign * float(axis @ now.wrenches[k, 0])
            return total

        return reaction

    def _torque(self, joint: Any, axis: Array) -> _Reader:
        bodies = self._subtree(joint)
        inputs = self._inputs_on(bodies)
        signs = self._strut_signs(bodies)
        loops = self._loops_on(bodies)
        child = joint.getChildBodyNode()

        def torque(now: _Instant) -> float:
            frame = joint.getTransformFromChildBodyNode().matrix()
            pivot = (child.getWorldTransform().matrix() @ frame)[:3, 3]
            total = np.zeros(3)
            for body in bodies:
                excess = body.getCOMLinearAcceleration() - self._gravity
                total += np.cross(body.getCOM() - pivot, body.getMass() * excess)
                total += _spin_moment(body)
            pushes = now.forces_n[:, np.newaxis] * now.directions
            for sign, points in zip(signs, now.ends, strict=True):
                total -= np.sum(np.cross(points - pivot, sign[:, np.newaxis] * pushes), axis=0)
            for column, body, at, direction in inputs:
                point = (body.getWorldTransform().matrix() @ np.append(at, 1.0))[:3]
                total -= np.cross(point - pivot, float(now.inputs[column]) * direction)
            for k, sign, place in loops:
                force_n, torque = sign * now.wrenches[k]
                total -= np.cross(place() - pivot, force_n) + torque
            return float(axis @ total)

        return torque

    def _subtree(self, joint: Any) -> list[Any]:
        """The child body of a joint, and all that hang on it."""
        found = [joint.getChildBodyNode()]
        names = {found[0].getName()}
        for body in self._dart.getBodyNodes():
            parent = body.getParentBodyNode()
            if parent is not None and parent.getName() in names:
                found.append(body)
                names.add(body.getName())
        return found

    def _inputs_on(self, bodies: Sequence[Any]) -> list[tuple[int, Any, Array, Array]]:
        """Column, body, point and direction of the force inputs that act on some bodies."""
        names = {body.getName() for body in bodies}
        return [item for item in self._skeleton.inputs.forces if item[1].getName() in names]

    def _loops_on(self, bodies: Sequence[Any]) -> list[tuple[int, float, Callable[[], Array]]]:
        """Index, sign and place (m) of the joints of loops that act on some bodies from outside."""
        loops, names = self._skeleton.loops, {body.getName() for body in bodies}
        found: list[tuple[int, float, Callable[[], Array]]] = []
        for k, (spec, place) in enumerate(() if loops is None else loops.places()):
            first, second = (name in names for name in spec.between)
            if first != second:
                found.append((k, 1.0 if second else -1.0, place))
        return found

    def _strut_signs(self, bodies: Sequence[Any]) -> Array:
        """How a strut's force acts on some bodies by its lower and upper end, (2, struts)."""
        names = {body.getName() for body in bodies}
        ends = [
            [float(strut.between[end] in names and strut.between[end] != WORLD) for end in (0, 1)]
            for strut in self._spec.struts
        ]
        return np.array(ends).T * np.array([[-1.0], [1.0]])


def turning_joints(spec: ModelSpec) -> frozenset[str]:
    """Names of the joints of a model whose coordinate is an angle.

    Raises:
        ModelError: The skeleton cannot be built.
    """
    joints = cast("Any", build(spec).dart).getJoints()
    return frozenset(it.getName() for it in joints if it.getType() == _TURNING)


def _spin_moment(body: Any) -> Array:
    """Rate of change of a body's spin about its centre of mass, in the world's directions."""
    rotation = np.array(body.getWorldTransform().matrix()[:3, :3])
    own = np.array(body.getInertia().getMoment())
    moment = rotation @ own @ rotation.T
    rate = np.array(body.getAngularVelocity())
    spin = moment @ rate
    return moment @ np.array(body.getAngularAcceleration()) + np.cross(rate, spin)


def _find(name: str, choices: dict[str, Any], where: str) -> Any:
    if name not in choices:
        raise ModelError(f"{where} {name!r}: {expected_name(name, list(choices))}")
    return choices[name]
