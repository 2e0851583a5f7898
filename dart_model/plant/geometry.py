"""Heights and Jacobians of the struts as functions of the joint coordinates."""

import math
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from dart_model.errors import ModelError
from dart_model.plant.coordinates import sample_positions
from dart_model.plant.skeleton import Skeleton
from dart_model.spec import WORLD, ModelSpec, StrutSpec

Array = NDArray[np.float64]

_NEWTON_STEPS = 50
"""Newton's method doubles its digits at each step, once it is near: more steps change nothing."""
_REACHED_M, _OUT_OF_REACH_M = 1e-13, 1e-9
"""Error of a height at which Newton's method ends, and above which it has failed."""
_LONGEST_MOVE = 0.1
"""Longest move (m or rad) of the free coordinates at once where loops have to be closed behind."""
_DISAGREEMENT_M = 5e-4
"""Disagreement of the sensors of more struts than coordinates that noise explains."""
_SHORTEST_M = 1e-12
"""Length of a strut below which its direction is not defined."""


class Jacobians(NamedTuple):
    """Struts and inputs in one configuration `q`, of n coordinates.

    Attributes:
        offsets_m: Heights less ``struts @ q``, shape (struts,).
        struts: Derivative of the heights by the coordinates, shape (struts, n).
        inputs: Generalised force per unit of each input, shape (n, inputs); in the row of a moved
            coordinate its acceleration.
    """

    offsets_m: Array
    struts: Array
    inputs: Array

    def heights_m(self, q: Array) -> Array:
        """Strut heights, shape (struts,); exact at the configuration itself."""
        return self.offsets_m + self.struts @ q


class _Attached(NamedTuple):
    """The lower ends of all struts, then the upper ones.

    Attributes:
        bodies: Index of each end's body among those that carry ends, the world last; shape
            (2, struts).
        attachments_m: Ends in the frames of their bodies, shape (2, struts, 3).
    """

    bodies: NDArray[np.intp]
    attachments_m: Array


class _Ends(NamedTuple):
    """The ends in one configuration, in the world's directions.

    Attributes:
        arms_m: From the bodies' origins to the ends, shape (2, struts, 3).
        jacobians: Of the ends' bodies, turning above moving, shape (2, struts, 6, n).
        gaps_m: From lower to upper ends, shape (struts, 3).
    """

    arms_m: Array
    jacobians: Array
    gaps_m: Array

    def gap_jacobians(self) -> Array:
        """Derivative of the gaps by the coordinates, shape (struts, 3, n)."""
        turned = _cross(self.jacobians[..., :3, :].swapaxes(2, 3), self.arms_m[:, :, None])
        lower, upper = self.jacobians[..., 3:, :] + turned.swapaxes(2, 3)
        return upper - lower


class Geometry:
    """The struts of a model on its skeleton.

    The height of a strut whose ends move along one straight line is measured upwards along it and
    has a sign, so that a bench may be given about its rest position; the height of any other strut
    is the distance of its ends.

    Args:
        skeleton: Its bodies and joints in DART; their positions and velocities are overwritten by
            every call.

    Raises:
        ModelError: No joint lets the ends of a strut move.
    """

    def __init__(self, spec: ModelSpec, skeleton: Skeleton) -> None:
        self._spec = spec
        self._skeleton = skeleton
        names = sorted({name for strut in spec.struts for name in strut.between} - {WORLD})
        # One call of DART for each body: one for each end would take three times as long.
        self._carriers = [skeleton.bodies[name] for name in names]
        indices = {name: index for index, name in enumerate([*names, WORLD])}
        self._attached = _Attached(
            np.array([[indices[strut.between[k]] for strut in spec.struts] for k in (0, 1)]),
            np.array([[strut.attachments_m[k] for strut in spec.struts] for k in (0, 1)], float),
        )
        samples = [self._ends_at(q) for q in sample_positions(skeleton.coordinates)]
        columns = np.concatenate([ends.gap_jacobians() for ends in samples], axis=2)
        self._guides = np.array(
            [_guide(spec.name, *item) for item in zip(spec.struts, columns, strict=True)]
        )
        """Directions of guided struts, shape (struts, 3); NaN where the height is a distance."""
        self._is_distance = np.isnan(self._guides[:, 0])
        self.is_free = np.zeros(skeleton.coordinates)
        """1 for a coordinate that is free to move, 0 for one that is moved, shape (n,)."""
        self.is_free[skeleton.inputs.free] = 1.0
        self.constant = self._same_everywhere() if skeleton.loops is None else None
        """The Jacobians, if they are the same in every configuration and no loop is closed."""

    def at(self, q: Array) -> Jacobians:
        """Jacobians at coordinates `q`, shape (n,)."""
        ends = self._ends_at(q)
        directions = self._directions(ends.gaps_m)
        wrenches = np.empty((2, len(directions), 6))
        wrenches[..., :3] = _cross(ends.arms_m, directions)
        wrenches[..., 3:] = directions
        lower, upper = (wrenches[:, :, None] @ ends.jacobians)[:, :, 0]
        struts = upper - lower
        heights = np.sum(directions * ends.gaps_m, axis=1)
        return Jacobians(heights - struts @ q, struts, self._skeleton.inputs.columns())

    def centripetal(self, q: Array, v: Array) -> Array:
        """Second derivative of the heights at `q` with constant rates `v`, shape (struts,).

        It is the time derivative of the struts' Jacobian times the rates: centripetal
        accelerations, and of a distance the motion of its ends across it.

        Reference: Featherstone, "Rigid Body Dynamics Algorithms" (2008), 2.10 and 3.
        """
        if self.constant is not None:
            return np.zeros(len(self.constant.struts))
        dart, bodies = self._skeleton.dart, self._attached.bodies
        ends = self._ends_at(q)
        directions, lengths = self._directions(ends.gaps_m), _lengths(ends.gaps_m)
        dart.setVelocities(v)
        still = np.zeros((6, len(q)))
        changes = np.array([*(dart.getJacobianClassicDeriv(of) for of in self._carriers), still])
        rates, changed = ends.jacobians @ v, (changes @ v)[bodies]
        spins, across = rates[..., :3], _cross(rates[..., :3], ends.arms_m)
        velocities = rates[..., 3:] + across
        accelerations = (
            changed[..., 3:] + _cross(changed[..., :3], ends.arms_m) + _cross(spins, across)
        )
        velocity, acceleration = np.diff([velocities, accelerations], axis=1)[:, 0]
        along = np.sum(directions * velocity, axis=1)
        sideways = velocity - along[:, None] * directions
        swung = np.where(self._is_distance, np.sum(sideways * sideways, axis=1) / lengths, 0.0)
        return np.sum(directions * acceleration, axis=1) + swung

    def _directions(self, gaps_m: Array) -> Array:
        """Along which heights are measured, shape (struts, 3)."""
        if not self._is_distance.any():
            return self._guides
        along = gaps_m / _lengths(gaps_m)[:, None]
        return np.where(self._is_distance[:, None], along, self._guides)

    def _ends_at(self, q: Array) -> _Ends:
        """The ends at coordinates `q`."""
        dart, (bodies, attachments), carriers = self._skeleton.dart, self._attached, self._carriers
        dart.setPositions(q)
        frames = np.array([*(of.getWorldTransform().matrix() for of in carriers), np.eye(4)])
        still = np.zeros((6, self._skeleton.coordinates))
        jacobians = np.array([*(dart.getWorldJacobian(of) for of in carriers), still])[bodies]
        here = frames[bodies]
        arms = (here[..., :3, :3] @ attachments[..., None])[..., 0]
        lower, upper = here[..., :3, 3] + arms
        return _Ends(arms, jacobians, upper - lower)

    def lines(self, q: Array) -> tuple[Array, Array]:
        """Directions (struts, 3) along which struts push, and their ends, (2, struts, 3), at `q`.

        In m and in the world's directions, lower ends first.
        """
        ends = self._ends_at(q)
        bodies, _ = self._attached
        frames = [of.getWorldTransform().matrix()[:3, 3] for of in self._carriers]
        origins = np.array([*frames, np.zeros(3)])[bodies]
        return self._directions(ends.gaps_m), origins + ends.arms_m

    def reaching(self, heights_m: Array, near: Array) -> Array:
        """Coordinates with given strut heights, by Newton's method; moved ones stay where they are.

        Heights of more struts than coordinates are those of sensors that disagree by their noise:
        the coordinates are the nearest, in the least squares. Loops are closed.

        Args:
            heights_m: One height a strut, shape (struts,); NaN where none is given.
            near: Start of the iteration, shape (n,).

        Raises:
            ModelError: The joints cannot reach the heights.
        """
        q, given = near, np.isfinite(heights_m)
        free, loops = self._skeleton.free, self._skeleton.loops
        for _ in range(_NEWTON_STEPS):
            here = self.at(q)
            error = (heights_m - here.heights_m(q))[given]
            if float(np.max(np.abs(error), initial=0.0)) < _REACHED_M:
                break
            struts = here.struts if loops is None else here.struts @ loops.spread(q)
            step = np.linalg.lstsq(struts[given][:, free], error, rcond=None)[0]
            q = q.copy()
            if loops is None:
                q[free] += step
            else:
                step *= min(1.0, _LONGEST_MOVE / max(float(np.abs(step).max()), 1e-300))
                q[free] += step
                q = loops.close(q)
            if float(np.max(np.abs(step))) < _REACHED_M:
                break
        allowed_m = _OUT_OF_REACH_M if np.sum(given) <= len(free) else _DISAGREEMENT_M
        reached = self.at(q).heights_m(q)[given]
        if not np.allclose(reached, heights_m[given], rtol=0.0, atol=allowed_m):
            raise ModelError(
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


def _guide(model: str, strut: StrutSpec, columns: Array) -> Array:
    """Direction (3,) of a strut on a straight line, else NaN; by its gap's derivatives (3, m)."""
    directions, singular, _ = np.linalg.svd(columns)
    if singular[0] < 1e-9:
        raise ModelError(
            f"model {model}: strut {strut.name}: no joint lets {strut.between[0]} and "
            f"{strut.between[1]} move, expected one that does"
        )
    if len(singular) > 1 and singular[1] > 1e-9 * singular[0]:
        return np.full(3, np.nan)
    direction = cast("Array", np.round(directions[:, 0], 14))  # exact for guides along an axis
    largest = direction[2] if direction[2] != 0.0 else direction[np.argmax(np.abs(direction))]
    return direction * math.copysign(1.0, largest)


def _lengths(vectors: Array) -> Array:
    """Lengths of vectors of shape (struts, 3), none shorter than what has a direction."""
    return np.maximum(np.sqrt(np.sum(vectors * vectors, axis=1)), _SHORTEST_M)


def _cross(a: Array, b: Array) -> Array:
    """Vector products of the last axes; numpy's own takes four times as long."""
    return a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT]


_NEXT, _AFTER = [1, 2, 0], [2, 0, 1]
"""Of a right-handed triad."""
