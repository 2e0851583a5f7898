"""The linear dynamics of a model about its mean configuration: heights by generalised forces."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import expm

from dart_model.effects import Motion
from rig.diagnosis.numerics.laws import CUBE, MATRIX, compile_loop, inline
from rig.diagnosis.problem import linear_part
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.mechanism import LinearisedMechanism, solve_nearest
from rig.diagnosis.problem.problem import LinearParameter
from rig.files.numba_alone import types

Array = NDArray[np.float64]

_FILTER_ANGLE = 0.25
"""Longest step of the linear dynamics under a force that is linear between samples, as an angle."""
_SETTLES_WITHIN = 0.15
"""Time constant of the slowest response of the regression's dynamics, as a share of a segment."""


def _respond_as_one(
    transition: Array,
    early: Array,
    late: Array,
    output: Array,
    directions: Array,
    forces: Array,
    heights: Array,
) -> None:
    samples = forces.shape[0]
    a00, a01, a10, a11 = transition[0, 0], transition[0, 1], transition[1, 0], transition[1, 1]
    b0, b1, c0, c1 = early[0, 0], early[1, 0], late[0, 0], late[1, 0]
    unit = output[0, 0]
    for c in range(forces.shape[1]):
        u = 0.0
        v = 0.0
        for k in range(samples):
            heights[k, 0, c] = unit * u
            if k + 1 < samples:
                f = directions[k, 0] * forces[k, c]
                g = directions[k + 1, 0] * forces[k + 1, c]
                u, v = a00 * u + a01 * v + b0 * f + c0 * g, a10 * u + a11 * v + b1 * f + c1 * g


@inline
def _row_product(matrix: Array, i: int, rows: Array, k: int) -> float:
    total = 0.0
    for j in range(rows.shape[1]):
        total += matrix[i, j] * rows[k, j]
    return total


def _respond_alone(
    transition: Array,
    early: Array,
    late: Array,
    output: Array,
    directions: Array,
    forces: Array,
    heights: Array,
) -> None:
    size = transition.shape[0]
    x = np.zeros(size)
    y = np.zeros(size)
    for k in range(forces.shape[0]):
        for i in range(output.shape[0]):
            total = 0.0
            for j in range(output.shape[1]):
                total += output[i, j] * x[j]
            heights[k, i, 0] = total
        if k + 1 == forces.shape[0]:
            break
        for i in range(size):
            total = 0.0
            for j in range(size):
                total += transition[i, j] * x[j]
            before = _row_product(early, i, directions, k)
            after = _row_product(late, i, directions, k + 1)
            y[i] = total + before * forces[k, 0] + after * forces[k + 1, 0]
        x, y = y, x


def _respond_together(
    transition: Array,
    early: Array,
    late: Array,
    output: Array,
    directions: Array,
    forces: Array,
    heights: Array,
) -> None:
    size, samples, columns = transition.shape[0], forces.shape[0], forces.shape[1]
    # Columns last and innermost: they go through the processor side by side.
    x = np.zeros((size, columns))
    y = np.zeros((size, columns))
    heights[:] = 0.0
    for k in range(samples):
        for i in range(output.shape[0]):
            for j in range(output.shape[1]):
                share = output[i, j]
                for c in range(columns):
                    heights[k, i, c] += share * x[j, c]
        if k + 1 == samples:
            break
        for i in range(size):
            before = _row_product(early, i, directions, k)
            after = _row_product(late, i, directions, k + 1)
            for c in range(columns):
                y[i, c] = before * forces[k, c] + after * forces[k + 1, c]
            for j in range(size):
                share = transition[i, j]
                for c in range(columns):
                    y[i, c] += share * x[j, c]
        x, y = y, x


_RESPOND = types.void(*(MATRIX,) * 6, CUBE)
_respond_as_one = compile_loop(_respond_as_one, _RESPOND)
_respond_alone = compile_loop(_respond_alone, _RESPOND)
_respond_together = compile_loop(_respond_together, _RESPOND)


class FilterMechanism:
    """The mechanism, given at nodes, on the grid `t_s` (N,) of the filter.

    `inputs` is the input vector on that grid, shape (N, inputs).
    """

    def __init__(
        self, mechanism: LinearisedMechanism, nodes_s: Array, t_s: Array, inputs: Array
    ) -> None:
        at = np.zeros(len(t_s), dtype=np.int64)
        if mechanism.is_tabulated:
            at = np.clip(np.searchsorted(nodes_s, t_s - 1e-12), 0, len(nodes_s) - 1)
        self._mechanism, self._at, self._inputs = mechanism, at, inputs
        self.jacobian = mechanism.jacobian[at]

    def unit_force(
        self,
        parameter: LinearParameter,
        track: Track,
        accelerations_m_per_s2: Array,
        motions: Sequence[Motion],
    ) -> Array:
        """Generalised force (N, n) of a unit change of a parameter; accelerations (N, struts)."""
        strut = parameter.strut
        if parameter.kind == "mass":
            q = solve_nearest(self.jacobian, accelerations_m_per_s2)
            inertia = np.einsum("kij,kj->ki", self._mechanism.mass_by_kg[self._at, strut], q)
            inputs = self._mechanism.inputs_by_kg[self._at, strut]
            driven = np.einsum("kij,kj->ki", inputs, self._inputs)
            return self._mechanism.bias_by_kg[self._at, strut] + driven - inertia
        if parameter.kind == "gain":
            column = self._mechanism.inputs[self._at][:, :, parameter.input]
            return column * self._inputs[:, parameter.input, np.newaxis]
        height_m, velocity = track.heights_m[strut], track.velocities_m_per_s[strut]
        force = linear_part.strut_force(parameter.kind, height_m, velocity, motions[strut])
        return self.jacobian[:, strut] * force[:, np.newaxis]


class LinearDynamics:
    """The linear dynamics of a model about its mean configuration, discretised.

    Args:
        constants: Strut constants, shape (struts, 5).
        duration_s: Length of the part of a recording that is filtered.
        coarse_s: Time between the samples of the regression.
    """

    def __init__(
        self, m: LinearisedMechanism, constants: Array, duration_s: float, coarse_s: float
    ) -> None:
        n = m.coordinates
        jacobian: Array = m.jacobian.mean(axis=0)
        mass = m.mass.mean(axis=0)
        stiffness = jacobian.T @ np.diag(constants[:, 1]) @ jacobian - m.bias_q.mean(axis=0)
        damping = jacobian.T @ np.diag(constants[:, 2]) @ jacobian - m.bias_v.mean(axis=0)
        self.more_stiffness, self.more_damping = _settling_terms(
            mass, stiffness, damping, 1.0 / (_SETTLES_WITHIN * duration_s)
        )
        a = system_matrix(mass, stiffness + self.more_stiffness, damping + self.more_damping)
        fastest = float(np.max(np.abs(np.linalg.eigvals(a))))
        self.finer = max(1, int(np.ceil(fastest * coarse_s / _FILTER_ANGLE)))
        step = coarse_s / self.finer
        b = np.vstack([np.zeros((n, n)), np.linalg.inv(mass)])
        augmented = np.zeros((4 * n, 4 * n))
        augmented[: 2 * n, : 2 * n] = a * step
        augmented[: 2 * n, 2 * n : 3 * n] = b * step
        augmented[2 * n : 3 * n, 3 * n :] = np.eye(n)
        e = expm(augmented)
        late = e[: 2 * n, 3 * n :]
        parts = (
            e[: 2 * n, : 2 * n],
            e[: 2 * n, 2 * n : 3 * n] - late,
            late,
            jacobian,
        )
        transition, early, late, output = (
            np.ascontiguousarray(part, dtype=np.float64) for part in parts
        )
        self._parts = transition, early, late, output
        self._jacobian = jacobian

    def heights(self, directions: Array, forces: Array) -> Array:
        """Heights (N, struts, k) from rest under forces (N, k) along generalised ones (N, n)."""
        out = np.empty((len(forces), len(self._jacobian), forces.shape[1]))
        several = _respond_alone if forces.shape[1] == 1 else _respond_together
        loop = _respond_as_one if self._jacobian.size == 1 else several
        loop(*self._parts, np.ascontiguousarray(directions), np.ascontiguousarray(forces), out)
        return out

    def holding_forces(self, z: Array, w: Array, nodes_s: Array, t_s: Array) -> Array:
        """Generalised force (N, n) of the settling terms, along a difference of heights."""
        inverse = np.linalg.pinv(self._jacobian)
        force = z @ inverse.T @ self.more_stiffness.T + w @ inverse.T @ self.more_damping.T
        return CubicSpline(nodes_s, force)(t_s)

    def free_motions(self, samples: int) -> list[Array]:
        """Heights (N, struts) of the free motion from a unit of each coordinate and velocity."""
        transition, output = self._parts[0], self._parts[3]
        powers = np.eye(len(transition))[np.newaxis]
        ahead = transition
        while len(powers) < samples:
            powers = np.concatenate([powers, powers @ ahead])
            ahead = ahead @ ahead
        n = output.shape[1]
        return [(output @ powers[:samples, :n, i].T).T for i in range(len(transition))]


def system_matrix(mass: Array, stiffness: Array, damping: Array) -> Array:
    """System matrix of coordinates and velocities."""
    n = len(mass)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower], dtype=np.float64)


def _settling_terms(
    mass: Array, stiffness: Array, damping: Array, slowest: float
) -> tuple[Array, Array]:
    """Stiffness and damping to add so that no response outlasts a time constant, each (n, n)."""
    n = len(mass)
    more_stiffness, more_damping = np.zeros((n, n)), np.zeros((n, n))
    softest = float(np.min(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real))
    if softest < 4.0 * slowest**2:
        more_stiffness = mass * (4.0 * slowest**2 - min(softest, 0.0))
    poles = np.linalg.eigvals(system_matrix(mass, stiffness + more_stiffness, damping)).real
    if float(np.max(poles)) > -slowest:
        more_damping = mass * 2.0 * (slowest + max(float(np.max(poles)), 0.0))
    return more_stiffness, more_damping
