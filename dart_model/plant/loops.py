"""Joints that close chains of bodies: what they hold together, and the forces that do it.

DART's joints form a tree. A joint of a loop is a constraint on its coordinates: of a ball joint
three rows, that its two points are one; of a revolute joint two more, that its two axes are one. In
a plane some rows are always satisfied where the others are; of the rows a largest independent part
is kept. Its multipliers are the forces of the joint.

Of the coordinates that no input moves, as many as there are rows depend on the others, which are
called free.

References:
    Featherstone, "Rigid Body Dynamics Algorithms" (2008), 8, closed-loop systems.
    Hairer, Wanner, "Solving Ordinary Differential Equations II" (1996), VII.2: projection onto the
    constraints after a step leaves the order of a method as it is.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr  # pyright: ignore[reportUnknownVariableType]

from dart_model.errors import ModelError
from dart_model.plant.coordinates import Move
from dart_model.plant.dart_types import DartBody, DartSkeleton
from dart_model.spec import WORLD, LoopSpec

Array = NDArray[np.float64]
Integers = NDArray[np.intp]

_CLOSED, _OPEN = 1e-13, 1e-9
"""Gap (m, or of the axes' directions) at which Newton's method ends, and above which it failed."""
_NEWTON_STEPS = 50
"""Newton's method doubles its digits at each step, once it is near; before, this is five metres or
radians on the way."""
_NEAR = 1e-6
"""Gap, and move that closes it, from which on a step of Newton's method is the last: its error is
quadratic in the move."""
_LONGEST_MOVE = 0.1
"""Longest move (m or rad) of the free coordinates that the others follow at once, and of all of
them in a step of Newton's method: of the ways to close a loop, the one is kept that zero is on."""
_RANK = 1e-7
"""Singular value, as a share of the largest, below which a row or column is not independent."""
_SINGULAR = 1e-10
"""The same of the rows' inverse inertia, which is quadratic in them."""
_NEARBY = 1e-2
"""Move (m or rad) from zero, to see whether the constraints are everywhere as they are there."""
_PREFERENCE = 10.0
"""How much rather the coordinates of joints with several of them depend on the others: a free
coordinate is one along an axis then, where it can be."""


class _End(NamedTuple):
    """A body of a loop: its point, and for a revolute joint its two directions, in its frame.

    Without a body it is the world's.
    """

    body: DartBody | None
    point_m: Array
    directions: Array

    def frame(self) -> Array:
        """Where the body is, (4, 4)."""
        return np.eye(4) if self.body is None else self.body.getWorldTransform().matrix()


class Loops:
    """The joints of a model's loops on its skeleton.

    A call moves DART's skeleton to the coordinates that it is given.

    Args:
        model: Name of the model, for messages.
        movable: Indices of the coordinates that no input moves.
        move: Moves coordinates at rates.

    Raises:
        ModelError: A body is unknown, or a loop is redundant, or singular where all coordinates are
            zero, or nothing is left that moves.
    """

    def __init__(
        self,
        model: str,
        specs: Sequence[LoopSpec],
        dart: DartSkeleton,
        movable: Integers,
        move: Move,
    ) -> None:
        self._model, self._specs, self._dart, self._movable = model, specs, dart, movable
        self._move = move
        bodies = {body.getName(): body for body in dart.getBodyNodes()}
        zero = np.zeros(dart.getNumDofs())
        dart.setPositions(zero)
        self._ends = [
            _ends(spec, bodies, f"model {model}: skeleton.loops.{k}")
            for k, spec in enumerate(specs)
        ]
        every = self._every_row(zero)[:, movable]
        self._refuse_redundant(every)
        rank = _rank(every)
        _, _, order = qr(every.T, mode="economic", pivoting=True)
        self._rows = np.sort(np.asarray(order[:rank], np.intp))
        # Index arrays take as long as the algebra between them.
        self._rows_of_movable = np.ix_(self._rows, movable)
        self._block = np.ix_(movable, movable)
        weighted = every[self._rows] * self._preference()[movable]
        _, _, order = qr(weighted, mode="economic", pivoting=True)
        self.dependent = np.sort(movable[np.asarray(order[:rank], np.intp)])
        """Indices of the coordinates that follow from the others."""
        self.free = np.setdiff1d(movable, self.dependent)
        """Indices of the coordinates that are free to move."""
        self._given = np.setdiff1d(np.arange(len(zero)), self.dependent)
        if not len(self.free):
            raise ModelError(
                f"model {model}: skeleton.loops: nothing is left that moves, expected "
                f"{len(movable)} coordinates to be more than the loops' {rank} constraints"
            )
        self._refuse_singular_at_zero(rank)

    # --- positions and rates ----------------------------------------------------------------------

    def gaps(self, q: Array) -> Array:
        """What the constraints are not satisfied by at `q`, shape (rows,)."""
        return self._every_gap(q)[self._rows]

    def jacobian(self, q: Array) -> Array:
        """Derivative of the constraints by the coordinates at `q`, shape (rows, n)."""
        return self._every_row(q)[self._rows]

    def close(self, q: Array) -> Array:
        """Coordinates with the free and moved ones of `q`, the others so that the loops are closed.

        Raises:
            ModelError: They cannot be closed there.
        """
        return self._newton(q, self.dependent)

    def reach(self, q: Array) -> Array:
        """The same on the way from zero, whatever the others are in `q`."""
        given = self._given
        here = np.zeros(len(q))
        steps = max(1, int(np.ceil(np.abs(q[given]).max(initial=0.0) / _LONGEST_MOVE)))
        for step in range(1, steps + 1):
            here[given] = q[given] * (step / steps)
            here = self.close(here)
        return here

    def project(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The nearest coordinates and rates with closed loops; moved ones stay as they are.

        Raises:
            ModelError: As of `close`.
        """
        q = self._newton(q, self._movable)
        rows = self.jacobian(q)
        v = v.copy()
        v[self._movable] -= np.linalg.lstsq(rows[:, self._movable], rows @ v, rcond=None)[0]
        return q, v

    def spread(self, q: Array) -> Array:
        """Rates of all coordinates per rate of each that is free or moved, shape (n, n).

        The columns of those that depend on the others are zero.

        Raises:
            ModelError: The place is singular.
        """
        rows, given = self.jacobian(q), self._given
        every = np.eye(len(q))
        every[:, self.dependent] = 0.0
        own = rows[:, self.dependent]
        if _rank(own) < len(own):
            raise self._singular(q)
        every[np.ix_(self.dependent, given)] = -np.linalg.solve(own, rows[:, given])
        return every

    # --- forces -----------------------------------------------------------------------------------

    def multipliers(self, q: Array) -> tuple[Array, Array]:
        """Multipliers, shape (rows,), and the acceleration that they add to DART's, shape (n,).

        DART is at `q`, and has computed the accelerations without the loops.

        Raises:
            ModelError: The place is singular.
        """
        own = self._every_row_here()[self._rows_of_movable]
        mass = self._dart.getMassMatrix()[self._block]
        moved = np.linalg.solve(mass, own.T)
        values, vectors = np.linalg.eigh(own @ moved)
        if values[0] < _SINGULAR * values[-1]:
            raise self._singular(q)
        needed = -self._every_acceleration()[self._rows]
        multipliers = vectors @ ((vectors.T @ needed) / values)
        added = np.zeros(len(q))
        added[self._movable] = moved @ multipliers
        return multipliers, added

    def curvature(self) -> Array:
        """Second derivative of the constraints at DART's state, less Jacobian times acceleration.

        Shape (rows,).
        """
        rows = self._every_row_here() @ np.array(self._dart.getAccelerations())
        return (self._every_acceleration() - rows)[self._rows]

    def wrenches(self, multipliers: Array) -> Array:
        """Force (N) and torque (N·m) on each loop's second body at its point, (loops, 2, 3).

        In the world's directions, where DART is; the first body has the opposite ones. Of what a
        redundant constraint would carry, nothing is known: it is taken to be nothing.
        """
        every = np.zeros(sum(_size(spec) for spec in self._specs))
        every[self._rows] = multipliers
        wrenches: list[Array] = []
        first = 0
        for spec, ends in zip(self._specs, self._ends, strict=True):
            own = every[first : first + _size(spec)]
            torque = _axis_rows(*ends).T @ own[3:] if len(own) > 3 else np.zeros(3)
            wrenches.append(np.stack([own[:3], torque]))
            first += _size(spec)
        return np.stack(wrenches)

    def places(self) -> list[tuple[LoopSpec, Callable[[], Array]]]:
        """Each loop, with what returns its point (m) in the world, where DART is."""
        ends = zip(self._specs, self._ends, strict=True)
        return [(spec, partial(_point, first)) for spec, (first, _) in ends]

    # --- all rows, where DART is ------------------------------------------------------------------

    def _every_row(self, q: Array) -> Array:
        self._dart.setPositions(q)
        return self._every_row_here()

    def _every_row_here(self) -> Array:
        rows: list[Array] = []
        for first, second in self._ends:
            rows.append(self._linear(second) - self._linear(first))
            if len(first.directions):
                rows.append(_axis_rows(first, second) @ (self._turn(second) - self._turn(first)))
        return np.vstack(rows)

    def _linear(self, end: _End) -> Array:
        if end.body is None:
            return np.zeros((3, self._dart.getNumDofs()))
        return self._dart.getLinearJacobian(end.body, end.point_m)

    def _turn(self, end: _End) -> Array:
        if end.body is None:
            return np.zeros((3, self._dart.getNumDofs()))
        return self._dart.getAngularJacobian(end.body)

    def _every_gap(self, q: Array) -> Array:
        self._dart.setPositions(q)
        gaps: list[Array] = []
        for first, second in self._ends:
            gaps.append(_point(second) - _point(first))
            if len(first.directions):
                gaps.append(_turned(first) @ _turned(second)[0])
        return np.concatenate(gaps)

    def _every_acceleration(self) -> Array:
        """Second derivative of all constraints by DART's coordinates, rates and accelerations."""
        found: list[Array] = []
        for first, second in self._ends:
            found.append(_acceleration(second) - _acceleration(first))
            if len(first.directions):
                rows = _axis_rows(first, second)
                spins, turns = zip(_spin(first), _spin(second), strict=True)
                axis, across = _turned(second)[0], _turned(first)
                change = np.cross(np.cross(spins[1], axis), across)
                change += np.cross(axis, np.cross(spins[0], across))
                bent = rows @ (turns[1] - turns[0]) + change @ (spins[1] - spins[0])
                found.append(np.asarray(bent, np.float64))
        return np.concatenate(found)

    # --- Newton's method, and what is refused -----------------------------------------------------

    def _newton(self, q: Array, varied: Integers) -> Array:
        for _ in range(_NEWTON_STEPS):
            gaps = self.gaps(q)
            largest = float(np.abs(gaps).max())
            if largest < _CLOSED:
                return q
            step = np.zeros(len(q))
            rows = self._every_row_here()[self._rows]
            step[varied] = np.linalg.lstsq(rows[:, varied], -gaps, rcond=None)[0]
            longest = float(np.abs(step).max())
            q = self._move(q, step * min(1.0, _LONGEST_MOVE / max(longest, 1e-300)), 1.0)
            if largest < _NEAR and longest < _NEAR:
                return q
        if np.abs(self._every_gap(q)).max() > _OPEN:
            raise ModelError(
                f"model {self._model}: skeleton.loops: cannot be closed with the coordinates "
                f"{_text(q)}, expected a place that the joints reach"
            )
        return q

    def _preference(self) -> Array:
        """Weights of the coordinates, larger where they rather depend on others, shape (n,)."""
        weights = np.ones(self._dart.getNumDofs())
        for joint in self._dart.getJoints():
            if joint.getNumDofs() > 1:
                for k in range(joint.getNumDofs()):
                    weights[joint.getIndexInSkeleton(k)] = _PREFERENCE
        return weights

    def _refuse_redundant(self, every: Array) -> None:
        first, before = 0, 0
        for k, spec in enumerate(self._specs):
            first += _size(spec)
            rank = _rank(every[:first])
            if rank == before:
                raise ModelError(
                    f"model {self._model}: skeleton.loops.{k}: redundant: the other joints hold "
                    f"{' and '.join(spec.between)} like this already, expected a loop that closes "
                    "a chain of bodies"
                )
            before = rank

    def _refuse_singular_at_zero(self, rank: int) -> None:
        """Refuse constraints of another rank, or not closed by those that are kept, beside zero."""
        n = self._dart.getNumDofs()
        near = np.zeros(n)
        near[self.free] = _NEARBY * np.cos(1.0 + np.arange(len(self.free)))
        try:
            near = self.close(near)
            is_regular = np.abs(self._every_gap(near)).max() < _OPEN
        except ModelError:
            is_regular = False
        if not is_regular or _rank(self._every_row(near)[:, self._movable]) != rank:
            raise ModelError(
                f"model {self._model}: skeleton.loops: the place where all coordinates are zero is "
                "singular: near it the loops hold more than there, expected one from which the "
                "bodies move as they do elsewhere"
            )

    def _singular(self, q: Array) -> ModelError:
        return ModelError(
            f"model {self._model}: skeleton.loops: the place with the coordinates {_text(q)} is "
            "singular: the loops do not determine how the bodies move on, expected a motion that "
            "stays away from it"
        )


def _ends(spec: LoopSpec, bodies: Mapping[str, DartBody], where: str) -> tuple[_End, _End]:
    """The two ends of a loop, where all coordinates are zero."""
    for name in spec.between:
        if name != WORLD and name not in bodies:
            raise ModelError(
                f"{where}: between {name!r}: expected one of {', '.join([WORLD, *bodies])}"
            )
    first, second = (_End(bodies.get(name), np.zeros(3), np.zeros((0, 3))) for name in spec.between)
    frame, other = first.frame(), second.frame()
    first = first._replace(point_m=np.array(spec.at))
    there = (frame @ np.append(first.point_m, 1.0))[:3]
    second = second._replace(point_m=other[:3, :3].T @ (there - other[:3, 3]))
    if spec.axis is not None:
        axis = np.array(spec.axis) / np.linalg.norm(spec.axis)
        # Two directions across the axis: rows of an orthonormal triad.
        across = np.linalg.svd(axis[np.newaxis])[2][1:]
        own = other[:3, :3].T @ frame[:3, :3] @ axis
        first = first._replace(directions=across)
        second = second._replace(directions=own[np.newaxis])
    return first, second


def _size(spec: LoopSpec) -> int:
    """Number of rows of a loop."""
    return 3 if spec.axis is None else 5


def _point(end: _End) -> Array:
    frame = end.frame()
    return frame[:3, :3] @ end.point_m + frame[:3, 3]


def _turned(end: _End) -> Array:
    """Directions of an end in the world, shape (directions, 3)."""
    return end.directions @ end.frame()[:3, :3].T


def _axis_rows(first: _End, second: _End) -> Array:
    """What multiplies the relative rate of turning in the rows of an axis, shape (2, 3)."""
    return np.asarray(np.cross(_turned(second)[0], _turned(first)), np.float64)


def _acceleration(end: _End) -> Array:
    return np.zeros(3) if end.body is None else end.body.getLinearAcceleration(end.point_m)


def _spin(end: _End) -> tuple[Array, Array]:
    """Rate of turning and its derivative."""
    if end.body is None:
        return np.zeros(3), np.zeros(3)
    return end.body.getAngularVelocity(), end.body.getAngularAcceleration()


def _rank(rows: Array) -> int:
    if not len(rows):
        return 0
    values = np.linalg.svd(rows, compute_uv=False)
    return int(np.sum(values > _RANK * max(values.max(initial=0.0), 1e-300)))


def _text(q: Array) -> str:
    return "[" + ", ".join(f"{value:.6g}" for value in q.tolist()) + "]"
