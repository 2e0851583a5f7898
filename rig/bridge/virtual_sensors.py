"""What virtual sensors show at a tick: variables of the model that follows the bench.

Bodies and joints move as the model does, under the estimated forces of the struts. Where an
observer states how well it knows a force, so is known what depends on it.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from msgspec import Struct

from dart_model.protocol import AnySensorReader
from rig.bridge.values import SensorOutput, StrutOutput


class StrutSensor(NamedTuple):
    """A virtual sensor of a strut: ``force_of``, ``power_of`` or ``energy_of``."""

    kind: str
    strut: int


class SensedState(Struct, frozen=True, gc=False):
    """What is remembered between two ticks.

    Attributes:
        gains: Change of each sensor of the model by a newton in each strut, where it started.
        powers_w: Power that each strut took.
        energies_j: Energy that each strut has taken since the model started.
    """

    t_ns: int
    gains: Sequence[Sequence[float]]
    powers_w: tuple[float, ...]
    energies_j: tuple[float, ...]


class VirtualSensors:
    """All virtual sensors of a run, in the order of its configuration.

    Args:
        sensors: A sensor of a strut, or None for one that `reader` reads.
        reader: Reads those of bodies and joints in their order; None where there are none.
    """

    def __init__(
        self, sensors: Sequence[StrutSensor | None], reader: AnySensorReader | None
    ) -> None:
        self._sensors, self._reader = tuple(sensors), reader

    @property
    def reads_model(self) -> bool:
        """Whether some are of bodies or joints, so that a model has to move."""
        return self._reader is not None

    def read(
        self,
        state: SensedState | None,
        t_ns: int,
        loaded: Any,
        struts: Sequence[StrutOutput],
    ) -> tuple[SensedState, tuple[SensorOutput, ...]]:
        """State and readings at a tick whose model is `loaded` and whose struts act as estimated.

        `loaded` is None where no model moves; then there are sensors of struts alone.
        """
        state = self._advance(state, t_ns, loaded, struts)
        values: Sequence[float] = ()
        if self._reader is not None:
            residual_n = [strut.force_n - strut.law_force_n for strut in struts]
            values = self._reader.read(loaded, residual_n)
        rest, readings = iter(zip(values, state.gains, strict=True)), list[SensorOutput]()
        for sensor in self._sensors:
            if sensor is not None:
                readings.append(_of_strut(sensor, struts[sensor.strut], state))
                continue
            value, gains = next(rest)
            square = 0.0
            for gain, strut in zip(gains, struts, strict=True):
                square += (gain * strut.force_std_n) ** 2
            # Of what no force changes at once, such as a position, nothing is known by a force.
            readings.append(SensorOutput(value, math.sqrt(square) if square else math.nan))
        return state, tuple(readings)

    def _advance(
        self, state: SensedState | None, t_ns: int, loaded: Any, struts: Sequence[StrutOutput]
    ) -> SensedState:
        powers_w = tuple([-strut.force_n * strut.velocity_m_per_s for strut in struts])
        if state is None:
            gains = () if self._reader is None else self._reader.force_gains(loaded)
            return SensedState(t_ns, gains, powers_w, (0.0,) * len(struts))
        half_s = 0.5e-9 * (t_ns - state.t_ns)
        energies_j = tuple(
            [
                energy_j + half_s * (before_w + now_w)
                for energy_j, before_w, now_w in zip(
                    state.energies_j, state.powers_w, powers_w, strict=True
                )
            ]
        )
        return SensedState(t_ns, state.gains, powers_w, energies_j)


def _of_strut(sensor: StrutSensor, strut: StrutOutput, state: SensedState) -> SensorOutput:
    match sensor.kind:
        case "force_of":
            return SensorOutput(strut.force_n, strut.force_std_n)
        case "power_of":
            std_w = abs(strut.velocity_m_per_s) * strut.force_std_n
            return SensorOutput(state.powers_w[sensor.strut], std_w)
        case _:
            return SensorOutput(state.energies_j[sensor.strut], math.nan)
