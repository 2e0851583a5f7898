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
from rig.diagnosis.recording import RecordingError

Array = NDArray[np.float64]

_REACHED_M = 1e-12
"""Error of a height at which Newton's method has arrived: a millionth of any sensor's step."""
_ONE_KG = EffectSpec(name="added_mass", parameters={"mass_kg": 1.0})


class Mechanism(NamedTuple):
    """Equations of motion about reference coordinates, constant (K = 1) or at N nodes (K = N).

    Attributes:
        q: Reference coordinates, shape (K, n).
        v: Their rates, shape (K, n).
        heights_m: Strut heights there, shape (K, struts).
        jacobian: Jacobian of the struts, shape (K, struts, n).
        applied: Generalised force per newton of applied force, shape (K, n).
        mass: Mass matrix, shape (K, n, n).
        bias: Generalised force of all but struts and applied force, shape (K, n).
        bias_q: Its derivative by the coordinates, shape (K, n, n).
        bias_v: Its derivative by their rates, shape (K, n, n).
        mass_by_kg: Change of the mass matrix by a kg on each strut's body, shape
            (K, struts, n, n).
        bias_by_kg: The same of the bias force, shape (K, struts, n).
    """

    q: Array
    v: Array
    heights_m: Array
    jacobian: Array
    applied: Array
    mass: Array
    bias: Array
    bias_q: Array
    bias_v: Array
    mass_by_kg: Array
    bias_by_kg: Array

    @property
    def coordinates(self) -> int:
        """Number of coordinates."""
        return self.q.shape[1]

    def cut(self, nodes: slice) -> "Mechanism":
        """The mechanism at some of the nodes."""
        return self if len(self.q) == 1 else Mechanism(*(part[nodes] for part in self))


class Readers(NamedTuple):
    """DART with the model, and with a kg more on the body of each strut.

    Attributes:
        plain: The model without effects other than inertia.
        heavier: One for each strut.
    """

    plain: DartPlant
    heavier: tuple[DartPlant, ...]


def readers(spec: ModelSpec) -> Readers:
    """DART for a model.

    Raises:
        RecordingError: The measured heights do not give the motion of the model.
    """
    bare = spec
    for strut in spec.struts:
        kept = [e for e in strut.effects if e.name in ("added_mass", "inerter")]
        bare = bare.with_effects(strut.name, kept)
    plain = DartPlant(bare)
    if plain.coordinates != len(spec.struts):
        raise RecordingError(
            f"model {spec.name}: {plain.coordinates} coordinates and {len(spec.struts)} struts, "
            "expected as many of each, so that the measured heights give the motion"
        )
    heavier = tuple(
        DartPlant(bare.with_effects(strut.name, (*bare.strut(strut.name).effects, _ONE_KG)))
        for strut in bare.struts
    )
    return Readers(plain, heavier)


def constant(read: Readers) -> Mechanism:
    """The mechanism of bodies on straight guides."""
    n = read.plain.coordinates
    return _stacked([_at(read, np.zeros(n), np.zeros(n))])


def tabulated(read: Readers, heights_m: Array, velocities_m_per_s: Array) -> Mechanism:
    """The mechanism along a motion.

    Args:
        read: DART.
        heights_m: Heights at the nodes, without gaps, shape (N, struts).
        velocities_m_per_s: Their rates, shape (N, struts).

    Raises:
        InputError: The joints cannot reach the heights.
    """
    plant = read.plain
    q = np.array(plant.init(heights_m[0].tolist()).positions)
    entries: list[Mechanism] = []
    for height, velocity in zip(heights_m, velocities_m_per_s, strict=True):
        for _ in range(20):
            there = plant.jacobians(q)
            error = height - there.offsets_m - there.struts @ q
            q = q + np.linalg.lstsq(there.struts, error, rcond=None)[0]
            if float(np.max(np.abs(error))) < _REACHED_M:
                break
        v = np.linalg.lstsq(plant.jacobians(q).struts, velocity, rcond=None)[0]
        entries.append(_at(read, q, v))
    return _stacked(entries)


def _at(read: Readers, q: Array, v: Array) -> Mechanism:
    plain = read.plain
    there = plain.mechanics(q, v)
    bias_q, bias_v = plain.bias_slopes(q, v)
    heavier = [plant.mechanics(q, v) for plant in read.heavier]
    return Mechanism(
        q,
        v,
        there.heights_m,
        there.struts,
        there.applied,
        there.mass,
        there.bias,
        bias_q,
        bias_v,
        np.array([other.mass - there.mass for other in heavier]),
        np.array([other.bias - there.bias for other in heavier]),
    )


def _stacked(entries: list[Mechanism]) -> Mechanism:
    return Mechanism(*(np.ascontiguousarray(np.stack(part)) for part in zip(*entries, strict=True)))
