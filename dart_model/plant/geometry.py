"""Where the struts are: their heights and Jacobians as functions of the joint coordinates."""

import math
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from dart_model.plant.skeleton import Skeleton
from dart_model.spec import WORLD, ModelSpec, StrutSpec
from rig.inputs.errors import InputError

Array = NDArray[np.float64]

_NEWTON_STEPS = 50
"""Newton's method doubles its digits at each step, once it is near: more steps find nothing."""

_REACHED_M, _OUT_OF_REACH_M = 1e-13, 1e-9
"""Error of a height at which Newton's method ends, and above which it has failed."""

_DISAGREEMENT_M = 5e-4
"""By which sensors of more struts than coordinates may disagree: more is no noise."""

_RATE_STEP_S = 1e-6
"""Step of the central difference of a Jacobian in time."""


class Jacobians(NamedTuple):
    """Struts and applied force in one configuration `q`, of n coordinates.

    Attributes:
        offsets_m: Heights less ``struts @ q``, shape (struts,).
        struts: Derivative of the heights by the coordinates, shape (struts, n).
        applied: Generalised force per newton of applied force, shape (n,).
    """

    offsets_m: Array
    struts: Array
    applied: Array

    def heights_m(self, q: Array) -> Array:
        """Strut heights, shape (struts,); exact at the configuration itself."""
        return self.offsets_m + self.struts @ q


class Geometry:
    """The struts of a model on its skeleton.

    The height of a strut whose ends move along one straight line is measured upwards along it and
    has a sign, so that a bench may be given about its rest position; the height of any other strut
    is the distance of its ends.

    Args:
        spec: The model.
        skeleton: Its bodies and joints in DART; their positions are overwritten by every call.

    Raises:
        InputError: No joint lets the ends of a strut move.
    """

    def __init__(self, spec: ModelSpec, skeleton: Skeleton) -> None:
        self._spec = spec
        self._skeleton = skeleton
        self._guides = tuple(_guide(spec.name, strut, skeleton) for strut in spec.struts)
        self.constant = self._same_everywhere()
        """The Jacobians, if they are the same in every configuration."""

    def at(self, q: Array) -> Jacobians:
        """Jacobians at coordinates `q`, shape (n,)."""
        skeleton = self._skeleton
        skeleton.dart.setPositions(q)
        heights = np.empty(len(self._guides))
        struts = np.empty((len(self._guides), len(q)))
        for index, (strut, guide) in enumerate(zip(self._spec.struts, self._guides, strict=True)):
            gap, by_coordinates = _gap(strut, skeleton)
            direction = gap / max(float(np.linalg.norm(gap)), 1e-12) if guide is None else guide
            heights[index] = direction @ gap
            struts[index] = direction @ by_coordinates
        applied = np.array(skeleton.dart.getLinearJacobian(skeleton.pushed), dtype=np.float64)[2]
        return Jacobians(heights - struts @ q, struts, applied)

    def jacobian_rate(self, q: Array, v: Array) -> Array:
        """Time derivative of the struts' Jacobian at `q` with rates `v`, shape (struts, n)."""
        if self.constant is not None:
            return np.zeros_like(self.constant.struts)
        ahead = self.at(moved(self._skeleton, q, v, _RATE_STEP_S))
        behind = self.at(moved(self._skeleton, q, v, -_RATE_STEP_S))
        return (ahead.struts - behind.struts) / (2.0 * _RATE_STEP_S)

    def reaching(self, heights_m: Array, near: Array) -> Array:
        """Coordinates with given strut heights, found by Newton's method.

        Heights of more struts than coordinates are those of sensors that disagree by their noise:
        the coordinates are the nearest, in the least squares.

        Args:
            heights_m: One height a strut, shape (struts,); NaN where none is given.
            near: Where to begin, shape (n,).

        Raises:
            InputError: The joints cannot reach the heights.
        """
        q, given = near, np.isfinite(heights_m)
        for _ in range(_NEWTON_STEPS):
            here = self.at(q)
            error = (heights_m - here.heights_m(q))[given]
            if float(np.max(np.abs(error), initial=0.0)) < _REACHED_M:
                break
            step = np.linalg.lstsq(here.struts[given], error, rcond=None)[0]
            q = q + step
            if float(np.max(np.abs(step))) < _REACHED_M:
                break
        allowed_m = _OUT_OF_REACH_M if np.sum(given) <= len(q) else _DISAGREEMENT_M
        reached = self.at(q).heights_m(q)[given]
        if not np.allclose(reached, heights_m[given], rtol=0.0, atol=allowed_m):
            raise InputError(
                f"model {self._spec.name}: heights {heights_m.tolist()} m: out of the joints' reach"
            )
        return q

    def _same_everywhere(self) -> Jacobians | None:
        first, *others = [self.at(q) for q in sample_positions(self._skeleton.coordinates)]
        same = all(
            np.allclose(a, b, rtol=1e-9, atol=1e-12)
            for other in others
            for a, b in zip(first, other, strict=True)
        )
        return first if same else None


def moved(skeleton: Skeleton, q: Array, v: Array, h: float) -> Array:
    """Where rates `v` lead to from `q` in `h` seconds; rotations in space do not add up."""
    skeleton.dart.setPositions(q)
    skeleton.dart.setVelocities(v)
    skeleton.dart.integratePositions(h)
    return np.array(skeleton.dart.getPositions())


def coordinates_add_up(skeleton: Skeleton) -> bool:
    """Whether ``q + h * v`` is where rates lead to, as for all but rotations in space."""
    for q in sample_positions(skeleton.coordinates):
        v = np.roll(q, 1) + 1.0
        if not np.allclose(moved(skeleton, q, v, 0.5), q + 0.5 * v, rtol=0.0, atol=1e-12):
            return False
    return True


def sample_positions(coordinates: int) -> list[Array]:
    """Fixed generic configurations at which it is tested what is constant."""
    return [0.3 * np.sin(1.0 + (k + 0.7) * np.arange(1, coordinates + 1)) for k in range(4)]


def _gap(spec: StrutSpec, skeleton: Skeleton) -> tuple[Array, Array]:
    """Vector from a strut's lower to its upper end, shape (3,), and its Jacobian, shape (3, n)."""
    ends: list[Array] = []
    jacobians: list[Array] = []
    for name, attachment in zip(spec.between, spec.attachments_m, strict=True):
        local = np.array(attachment)
        if name == WORLD:
            ends.append(local)
            jacobians.append(np.zeros((3, skeleton.coordinates)))
        else:
            body = skeleton.bodies[name]
            transform = np.array(body.getWorldTransform().matrix())
            ends.append(transform[:3, :3] @ local + transform[:3, 3])
            jacobians.append(np.array(skeleton.dart.getLinearJacobian(body, local)))
    return ends[1] - ends[0], jacobians[1] - jacobians[0]


def _guide(model: str, strut: StrutSpec, skeleton: Skeleton) -> Array | None:
    """Direction of a strut whose ends move along one straight line, shape (3,), else None."""
    columns: list[Array] = []
    for q in sample_positions(skeleton.coordinates):
        skeleton.dart.setPositions(q)
        columns.append(_gap(strut, skeleton)[1])
    left, singular, _ = np.linalg.svd(np.hstack(columns))
    if singular[0] < 1e-9:
        raise InputError(
            f"model {model}: strut {strut.name}: no joint lets {strut.between[0]} and "
            f"{strut.between[1]} move, expected one that does"
        )
    if len(singular) > 1 and singular[1] > 1e-9 * singular[0]:
        return None
    direction = cast("Array", np.round(left[:, 0], 14))  # exact for guides along an axis
    largest = direction[2] if direction[2] != 0.0 else direction[np.argmax(np.abs(direction))]
    return direction * math.copysign(1.0, largest)
