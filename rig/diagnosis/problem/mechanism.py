"""The mechanism around the struts, read from DART: constant, or tabulated along a motion.

Mass matrix, bias forces and Jacobians are DART's own. Where they are the same everywhere (bodies on
straight guides) they are read once; else they are tabulated along the measured motion and linear
about it, so that a simulation which comes to follow the measurement follows DART.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
from rig.diagnosis.problem.fmu_force import forces_along
from rig.diagnosis.problem.grid import Track
from rig.recordings.recording import RecordingError

Array = NDArray[np.float64]

_ONE_KG = EffectSpec(name="added_mass", parameters={"mass_kg": 1.0})


class LinearisedMechanism(NamedTuple):
    """Equations of motion about reference coordinates, constant (K = 1) or at N nodes (K = N).

    Attributes:
        q: Reference coordinates, shape (K, n).
        v: Their rates, shape (K, n).
        heights_m: Strut heights there, shape (K, struts).
        rates_m_per_s: Their rates, shape (K, struts).
        jacobian: Jacobian of the struts, shape (K, struts, n).
        inputs: Generalised force per unit of each input, shape (K, n, inputs).
        moved: Derivative of the heights by the positions of moved bodies, shape
            (K, struts, motions).
        mass: Mass matrix, shape (K, n, n).
        bias: Generalised force of all but struts and inputs, shape (K, n).
        bias_q: Its derivative by the coordinates, shape (K, n, n).
        bias_v: Its derivative by their rates, shape (K, n, n).
        mass_by_kg: Change of the mass matrix by a kg on each strut's body, shape
            (K, struts, n, n).
        bias_by_kg: The same of the bias force, shape (K, struts, n).
        inputs_by_kg: The same of the inputs, shape (K, struts, n, inputs).
    """

    q: Array
    v: Array
    heights_m: Array
    rates_m_per_s: Array
    jacobian: Array
    inputs: Array
    moved: Array
    mass: Array
    bias: Array
    bias_q: Array
    bias_v: Array
    mass_by_kg: Array
    bias_by_kg: Array
    inputs_by_kg: Array

    @property
    def coordinates(self) -> int:
        """Number of coordinates."""
        return self.q.shape[1]

    @property
    def is_tabulated(self) -> bool:
        """Whether it is given at nodes, and not the same everywhere."""
        return len(self.q) > 1

    def cut(self, nodes: slice) -> "LinearisedMechanism":
        """The mechanism at some of the nodes."""
        if not self.is_tabulated:
            return self
        return LinearisedMechanism(*(part[nodes] for part in self))

    def strut_forces_of_motion(
        self, z: Array, w: Array, a: Array, inputs: Array, moved: Array
    ) -> Array:
        """Strut forces that heights, their rates and accelerations take, each (N, struts).

        Args:
            z: Heights.
            w: Their rates.
            a: Their second derivatives, without what moved bodies add to them.
            inputs: Input vector, shape (N, inputs).
            moved: What moved bodies add to heights and their rates, shape (N, 2, struts).
        """
        every = np.arange(len(z)) if self.is_tabulated else np.zeros(len(z), dtype=np.int64)
        jacobian, mass = self.jacobian[every], self.mass[every]
        q = self.q[every] + solve_nearest(jacobian, z - self.heights_m[every] - moved[:, 0])
        v = solve_nearest(jacobian, w - moved[:, 1])
        acceleration = solve_nearest(jacobian, a)
        bias = self.bias[every] + np.einsum("kij,kj->ki", self.inputs[every], inputs)
        bias = bias + np.einsum("kij,kj->ki", self.bias_q[every], q - self.q[every])
        bias = bias + np.einsum("kij,kj->ki", self.bias_v[every], v - self.v[every])
        generalised = np.einsum("kij,kj->ki", mass, acceleration) - bias
        return solve_nearest(np.swapaxes(jacobian, 1, 2), generalised)

    def about(self, z: Array, w: Array, moved: Array) -> "LinearisedMechanism":
        """The same mechanism, tabulated about another motion.

        Args:
            z: Heights of the motion, shape (N, struts).
            w: Their rates.
            moved: What moved bodies add to both, shape (N, 2, struts).
        """
        repeats = 1 if self.is_tabulated else len(z)
        m = LinearisedMechanism(*(np.repeat(part, repeats, axis=0) for part in self))
        q = m.q + solve_nearest(m.jacobian, z - m.heights_m - moved[:, 0])
        v = solve_nearest(m.jacobian, w - moved[:, 1])
        bias = m.bias + np.einsum("kij,kj->ki", m.bias_q, q - m.q)
        return m._replace(
            q=q,
            v=v,
            heights_m=m.heights_m + np.einsum("kij,kj->ki", m.jacobian, q - m.q),
            rates_m_per_s=np.einsum("kij,kj->ki", m.jacobian, v),
            bias=bias + np.einsum("kij,kj->ki", m.bias_v, v - m.v),
        )

    def held_to(
        self, z: Array, w: Array, moved: Array, rate_rad_per_s: float
    ) -> "LinearisedMechanism":
        """The mechanism held to a motion by springs and dampers on all that has a mass.

        Critically damped at a rate: they act as the gains of an observer do.

        Args:
            z: Heights of the motion, as of `about`.
            w: Their rates.
            moved: What moved bodies add to both.
            rate_rad_per_s: How fast an error decays that has no other cause.
        """
        m = self.about(z, w, moved)
        held = m._replace(
            bias_q=m.bias_q - rate_rad_per_s**2 * m.mass,
            bias_v=m.bias_v - 2.0 * rate_rad_per_s * m.mass,
        )
        return LinearisedMechanism(*(np.ascontiguousarray(part) for part in held))

    def without_balance(self, forces: Array) -> Array:
        """Strut forces (N, struts) without a part that is in balance with itself.

        There is such a part only where there are more struts than coordinates: no motion shows it.
        """
        _, struts, n = self.jacobian.shape
        if struts == n:
            return forces
        jacobian = self.jacobian[np.arange(len(forces)) if self.is_tabulated else slice(None)]
        transposed = np.swapaxes(jacobian, 1, 2)
        return solve_nearest(transposed, (transposed @ forces[..., np.newaxis])[..., 0])

    def shares_seen(self, nodes: int) -> Array:
        """Share [k, i, j] of the force of a strut j in that of i without balance, at some nodes.

        A projection at each node: the identity with as many struts as coordinates.
        """
        count, turned = self.jacobian.shape[1], np.swapaxes(self.jacobian, 1, 2)
        shares = self.jacobian @ np.linalg.solve(turned @ self.jacobian, turned)
        return np.broadcast_to(shares, (nodes, count, count))

    def strut_inertia(self) -> Array:
        """Strut forces per acceleration of a strut at the first node, by size, (struts, struts)."""
        jacobian = self.jacobian[0]
        accelerations = solve_nearest(jacobian, np.eye(len(jacobian)))
        return np.abs(solve_nearest(jacobian.T, accelerations @ self.mass[0].T).T)


class MechanismPlants(NamedTuple):
    """DART with the model (inertia its only effects), and with a kg more on each strut's body."""

    plain: DartPlant
    heavier: tuple[DartPlant, ...]


def open_plants(spec: ModelSpec) -> MechanismPlants:
    """DART for a model.

    Raises:
        RecordingError: The measured heights do not give the motion of the model.
    """
    bare = spec
    for strut in spec.struts:
        kept = [e for e in strut.effects if e.name in ("added_mass", "inerter")]
        bare = bare.with_effects(strut.name, kept)
    plain = DartPlant(bare)
    if plain.free_coordinates > len(spec.struts):
        raise RecordingError(
            f"model {spec.name}: {plain.free_coordinates} coordinates and {len(spec.struts)} "
            "struts, expected as many struts or more, so that the measured heights give the motion"
        )
    heavier = tuple(
        DartPlant(bare.with_effects(strut.name, (*bare.strut(strut.name).effects, _ONE_KG)))
        for strut in bare.struts
    )
    return MechanismPlants(plain, heavier)


def mechanism_along(plants: MechanismPlants, motion: Track, inputs: Array) -> LinearisedMechanism:
    """The mechanism along a measured motion: constant where it can be, and with FMUs' forces.

    `inputs` is the input vector at the motion's times, shape (N, inputs).
    """
    if plants.plain.is_constant:
        mechanism = constant_mechanism(plants)
    else:
        mechanism = tabulate_mechanism(
            plants, motion.heights_m.T, motion.velocities_m_per_s.T, inputs
        )
    return _with_mockups(mechanism, plants.plain, motion)


def _with_mockups(
    mechanism: LinearisedMechanism, plant: DartPlant, motion: Track
) -> LinearisedMechanism:
    """The mechanism with the forces of FMUs, along a motion and linear about it."""
    if not any(plant.mockups):
        return mechanism
    if mechanism.moved.shape[2]:
        raise RecordingError(
            f"model {plant.spec.name}: an FMU in a strut of a bench whose bodies are moved is not "
            "supported in a diagnosis, expected a bench that is driven by forces"
        )
    heights_m, velocities = motion.heights_m.T, motion.velocities_m_per_s.T
    m = mechanism.about(heights_m, velocities, np.zeros((len(heights_m), 2, heights_m.shape[1])))
    bias, bias_q, bias_v = m.bias, m.bias_q, m.bias_v
    for strut, mockup in enumerate(plant.mockups):
        if mockup is not None:
            row = m.jacobian[:, strut]
            force_n, by_height, by_velocity = forces_along(mockup, strut, motion)
            square = row[:, :, np.newaxis] * row[:, np.newaxis, :]
            bias = bias + row * force_n[:, np.newaxis]
            bias_q = bias_q + square * by_height[:, np.newaxis, np.newaxis]
            bias_v = bias_v + square * by_velocity[:, np.newaxis, np.newaxis]
    linearised = m._replace(
        heights_m=heights_m,
        rates_m_per_s=velocities,
        bias=bias,
        bias_q=bias_q,
        bias_v=bias_v,
    )
    return LinearisedMechanism(*(np.ascontiguousarray(part) for part in linearised))


def constant_mechanism(plants: MechanismPlants) -> LinearisedMechanism:
    """The mechanism of bodies on straight guides."""
    plain = plants.plain
    n = plain.coordinates
    here = _mechanism_at(plants, np.zeros(n), np.zeros(n))
    # About rest at zero, what moved bodies do by where they are and how fast is a part of it.
    by_position, by_velocity = plain.bias_slopes_by_motion(np.zeros(n), np.zeros(n))
    inputs = here.inputs.copy()
    inputs[:, plain.motion_columns] += by_position
    inputs[:, plain.motion_columns + 1] += by_velocity
    return _stack([here._replace(inputs=inputs)])


def tabulate_mechanism(
    plants: MechanismPlants, heights_m: Array, velocities_m_per_s: Array, inputs: Array
) -> LinearisedMechanism:
    """The mechanism along heights without gaps and their rates, shape (N, struts).

    `inputs` is the input vector there, shape (N, inputs).

    Raises:
        InputError: The joints cannot reach the heights.
    """
    plant = plants.plain
    first = plant.init(heights_m[0].tolist(), inputs=inputs[0].tolist())
    q = np.array(first.positions)
    entries: list[LinearisedMechanism] = []
    for height, velocity, given in zip(heights_m, velocities_m_per_s, inputs, strict=True):
        q, v = plant.following(q, height, velocity, given)
        entries.append(_mechanism_at(plants, q, v))
    return _stack(entries)


def _mechanism_at(plants: MechanismPlants, q: Array, v: Array) -> LinearisedMechanism:
    plain = plants.plain
    jacobians = plain.jacobians(q)
    here = plain.mechanics(q, v, jacobians)
    bias_q, bias_v = plain.bias_slopes(q, v)
    heavier = [plant.mechanics(q, v, jacobians) for plant in plants.heavier]
    return LinearisedMechanism(
        q[plain.free],
        v[plain.free],
        here.heights_m,
        jacobians.struts @ v,
        here.struts,
        here.inputs,
        here.moved,
        here.mass,
        here.bias,
        bias_q,
        bias_v,
        np.array([other.mass - here.mass for other in heavier]),
        np.array([other.bias - here.bias for other in heavier]),
        np.array([other.inputs - here.inputs for other in heavier]),
    )


def _stack(entries: list[LinearisedMechanism]) -> LinearisedMechanism:
    return LinearisedMechanism(
        *(np.ascontiguousarray(np.stack(part)) for part in zip(*entries, strict=True))
    )


def solve_nearest(rows: Array, values: Array) -> Array:
    """What gives values (..., m) by rows (..., m, n) best, and of all that do the least.

    With as many struts as coordinates it gives them exactly. With more struts, coordinates of
    measured heights are the nearest ones, and forces in the struts those without a part that is in
    balance with itself.
    """
    equations, unknowns = rows.shape[-2:]
    columns, turned = values[..., np.newaxis], np.swapaxes(rows, -1, -2)
    if equations == unknowns:
        found = np.linalg.solve(rows, columns)
    elif equations > unknowns:
        found = np.linalg.solve(turned @ rows, turned @ columns)
    else:
        found = turned @ np.linalg.solve(rows @ turned, columns)
    return np.asarray(found[..., 0], np.float64)
