"""A strut: its spring, damper and effects as one force, without DART."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C, effect
from dart_model.effects.calling import (
    MOTION,
    ForceOverArrays,
    RatesOverArrays,
    arguments,
    force_over_arrays,
    rates_over_arrays,
)
from dart_model.errors import ModelError
from dart_model.plant.fmu import MockUp
from dart_model.spec import ModelSpec, StrutSpec

Array = NDArray[np.float64]

_SAMPLED_M, _SAMPLED_M_PER_S = 0.5, 3.0
"""How far from the free length, and how fast, effects are sampled for their steepest slope."""

_SECANT_M, _SECANT_M_PER_S = 1e-3, 0.05
"""Half of the secants by which slopes are taken: more than noise moves a model, less than the width
of a knee."""

_LARGEST_N = 1e6
"""Force beyond which heights are not sampled: an exponential spring gives any force half a metre
from its free length, and no bench reaches a meganewton."""


class SlopeTable(NamedTuple):
    """Sizes of a force's slope between neighbouring points of a grid.

    Attributes:
        points: The grid, rising.
        sizes: One between two points each; at least that of the linear spring or damper.
    """

    points: list[float]
    sizes: list[float]

    @property
    def largest(self) -> float:
        """The steepest slope."""
        return max(self.sizes)

    def largest_within(self, low: float, high: float) -> float:
        """The steepest slope that a range touches; beyond the grid that at its end."""
        last = len(self.sizes) - 1
        first = min(max(bisect_right(self.points, low) - 1, 0), last)
        return max(self.sizes[first : max(bisect_left(self.points, high), first + 1)])


class _Part(NamedTuple):
    """A part of a strut's force: of an effect, or of an FMU.

    Attributes:
        name: What it is called in messages.
        first: Index of its first internal state in the model's.
        end: Index after its last one.
        reads: What it reads, by the names of `dart_model.effects.calling`.
    """

    name: str
    force: ForceOverArrays
    rates: RatesOverArrays
    parameters: Sequence[float]
    first: int
    end: int
    reads: Collection[str]


class Strut:
    """Force of a strut over height, velocity and internal states.

    Args:
        first_state: Index of its first internal state in the model's.
        gravity_m_per_s2: Standard gravity, for laws that carry a mass.
    """

    def __init__(
        self, spec: StrutSpec, first_state: int, gravity_m_per_s2: float, folder: Path
    ) -> None:
        self.name = spec.name
        linear = spec.free_length_m, spec.stiffness_n_per_m, spec.damping_n_s_per_m
        self._free_length, self._stiffness, self._damping = linear
        self._constants = (*linear, gravity_m_per_s2)
        parts: list[_Part] = []
        first = first_state
        for item in spec.effects:
            law = effect(item.name)
            end = first + law.state_size
            force, rates = force_over_arrays(law), rates_over_arrays(law)
            reads = {argument.name for argument in arguments(law.force, law)}
            parts.append(_Part(law.name, force, rates, item.values(), first, end, reads))
            first = end
        self.mockup: MockUp | None = None
        """FMU that gives a part of its force; its states are the strut's last."""
        if spec.fmu is not None:
            unit = self.mockup = MockUp(spec.fmu, folder, gravity_m_per_s2)
            end = first + len(unit.state_scales)
            parts.append(_Part(unit.name, unit.force, unit.rate, (), first, end, MOTION))
            first = end
        self._parts = tuple(parts)
        self._remembering = tuple(part for part in parts if part.end > part.first)
        self._over_height = tuple(part for part in parts if "height_m" in part.reads)
        self._over_velocity = tuple(part for part in parts if "velocity_m_per_s" in part.reads)
        self.states = first - first_state
        """Number of internal states."""

    def force_n(
        self,
        height_m: float,
        velocity_m_per_s: float,
        internal: Sequence[float],
        t_s: float,
        applied_force_n: float,
        temperature_c: float,
    ) -> float:
        """Force, positive when it pushes the two bodies apart.

        Args:
            height_m: Height.
            velocity_m_per_s: Velocity; positive is rebound.
            internal: Internal states of the whole model.
            t_s: Time, for effects that depend on it.
            applied_force_n: Applied force, for effects that act on it.
            temperature_c: Damper temperature.
        """
        force = self._stiffness * (self._free_length - height_m) - self._damping * velocity_m_per_s
        strut = self._constants
        for _, part_n, _, values, first, end, _ in self._parts:
            force += part_n(
                t_s, height_m, velocity_m_per_s, applied_force_n, temperature_c,
                internal[first:end], values, strut,
            )  # fmt: skip
        return force

    def write_rates(
        self,
        height_m: float,
        velocity_m_per_s: float,
        internal: Sequence[float],
        t_s: float,
        applied_force_n: float,
        temperature_c: float,
        internal_rates: list[float],
    ) -> None:
        """Write this strut's part of the derivative of `internal`; arguments as of `force_n`."""
        strut = self._constants
        for _, _, part_rates, values, first, end, _ in self._remembering:
            rates = [0.0] * (end - first)
            part_rates(
                t_s, height_m, velocity_m_per_s, applied_force_n, temperature_c,
                internal[first:end], values, strut, rates,
            )  # fmt: skip
            internal_rates[first:end] = rates

    @property
    def is_linear(self) -> bool:
        """Whether it has no effects, so that its slopes are the same everywhere."""
        return not self._parts

    def slopes(
        self,
        height_m: float,
        velocity_m_per_s: float,
        internal: Sequence[float],
        t_s: float,
        applied_force_n: float,
        temperature_c: float,
    ) -> tuple[float, float]:
        """Stiffness (N/m) and damping (N·s/m) about a motion; arguments as of `force_n`.

        They are secants, which smooth what is steeper than a control loop can use: the sign of dry
        friction, the edge of a stop.
        """
        low_m, high_m = height_m - _SECANT_M, height_m + _SECANT_M
        slow, fast = velocity_m_per_s - _SECANT_M_PER_S, velocity_m_per_s + _SECANT_M_PER_S
        stiffness, damping, strut = self._stiffness, self._damping, self._constants
        for _, part_n, _, values, first, end, _ in self._over_height:
            others = (
                velocity_m_per_s, applied_force_n, temperature_c, internal[first:end], values, strut
            )  # fmt: skip
            fall = part_n(t_s, low_m, *others) - part_n(t_s, high_m, *others)
            stiffness += fall / (2.0 * _SECANT_M)
        for _, part_n, _, values, first, end, _ in self._over_velocity:
            others = applied_force_n, temperature_c, internal[first:end], values, strut
            fall = part_n(t_s, height_m, slow, *others) - part_n(t_s, height_m, fast, *others)
            damping += fall / (2.0 * _SECANT_M_PER_S)
        return stiffness, damping

    def slope_tables(self) -> tuple[SlopeTable, SlopeTable]:
        """Stiffness (N/m) over height and damping (N·s/m) over velocity, with effects.

        They are sampled where a bench can get to.

        Raises:
            ModelError: The parameters of an effect give its law no value.
        """
        if not self._parts:
            everywhere = [-math.inf, math.inf]
            return (
                SlopeTable(everywhere, [self._stiffness]),
                SlopeTable(everywhere, [self._damping]),
            )
        heights = self._free_length + np.linspace(-_SAMPLED_M, _SAMPLED_M, 501)
        speeds = np.geomspace(1e-6, _SAMPLED_M_PER_S, 60)
        velocities = np.concatenate([-speeds[::-1], speeds])
        internal = [0.0] * self._parts[-1].end
        try:
            by_height = [
                self.force_n(x, 0.0, internal, 0.0, 0.0, AMBIENT_C) for x in heights.tolist()
            ]
            by_velocity = [
                self.force_n(self._free_length, v, internal, 0.0, 0.0, AMBIENT_C)
                for v in velocities.tolist()
            ]
        except (ArithmeticError, ValueError) as error:
            names = ", ".join(part.name for part in self._parts)
            raise ModelError(
                f"strut {self.name}: effects {names}: no force with these parameters ({error})"
            ) from error
        # An FMU may refuse what lies outside its range.
        slopes = np.abs(np.diff(by_height) / np.diff(heights))
        is_reached = np.maximum(np.abs(by_height[1:]), np.abs(by_height[:-1])) <= _LARGEST_N
        if np.any(is_reached & np.isfinite(slopes)):
            slopes[~is_reached] = np.nan
        rates = np.abs(np.diff(by_velocity) / np.diff(velocities))
        if not (np.any(np.isfinite(slopes)) and np.any(np.isfinite(rates))):
            raise ModelError(f"strut {self.name}: gives no force about its free length")
        return _table(heights, slopes, self._stiffness), _table(velocities, rates, self._damping)


def _table(points: Array, slopes: Array, least: float) -> SlopeTable:
    """Slopes as a table; one that is not known is the largest of those that are."""
    known = np.where(np.isfinite(slopes), slopes, np.nanmax(slopes))
    return SlopeTable(points.tolist(), np.maximum(known, least).tolist())


def struts_of(spec: ModelSpec) -> tuple[Strut, ...]:
    """The struts of a model, their internal states numbered through."""
    struts: list[Strut] = []
    first_state = 0
    for item in spec.struts:
        strut = Strut(item, first_state, spec.gravity_m_per_s2, spec.folder)
        first_state += strut.states
        struts.append(strut)
    return tuple(struts)
