"""What virtual sensors show at a tick: variables of the model that follows the bench.

Bodies and joints move as the model does, under the estimated forces of the struts. Where an
observer states how well it knows a force, so is known what depends on it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from dart_model.protocol import AnySensorReader
from rig.bridge.values import StrutOutput

Array = NDArray[np.float64]

_OF_STRUT = {"force_of": (0, 1), "power_of": (2, 3), "energy_of": (4, None)}
"""Places of value and standard deviation among the numbers of a strut."""
_STRUT_NUMBERS = 5
"""Of each strut: force and power, each with its standard deviation, and energy."""


class SensorPlace(NamedTuple):
    """What a virtual sensor reads.

    Attributes:
        kind: Its key, as of `dart_model.virtual_sensors`.
        strut: Index of the strut that it is of; -1 for a body or joint.
        has_std: Whether its standard deviation is shown, too.
    """

    kind: str
    strut: int
    has_std: bool


class SensedState(Struct, frozen=True, gc=False):
    """What is remembered between two ticks.

    Attributes:
        gains: Change of each sensor of the model by a newton in each strut, where it started,
            shape (sensors, struts).
        powers_w: Power that each strut took.
        energies_j: Energy that each strut has taken since the model started.
    """

    t_ns: int
    gains: Array
    powers_w: tuple[float, ...]
    energies_j: tuple[float, ...]


class VirtualSensors:
    """All virtual sensors of a run, in the order of its configuration.

    Args:
        sensors: What each reads.
        reader: Reads those of bodies and joints in their order; None where there are none.
    """

    def __init__(self, sensors: Sequence[SensorPlace], reader: AnySensorReader | None) -> None:
        self._reader = reader
        of_model = sum(sensor.strut < 0 for sensor in sensors)
        self._shows_std = any(sensor.strut < 0 and sensor.has_std for sensor in sensors)
        self._order: list[int] = []
        next_of_model = 0
        for sensor in sensors:
            if sensor.strut < 0:
                value, std = next_of_model, of_model + next_of_model
                next_of_model += 1
            else:
                begin = 2 * of_model + _STRUT_NUMBERS * sensor.strut
                at, at_std = _OF_STRUT[sensor.kind]
                value, std = begin + at, begin + (at_std or 0)
            self._order += [value, std] if sensor.has_std else [value]
        self._no_stds = [np.nan] * of_model

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
        covariance_n2: Callable[[], Array],
    ) -> tuple[SensedState, list[float]]:
        """State and readings at a tick whose model is `loaded` and whose struts act as estimated.

        `covariance_n2` is that of the errors of their forces, shape (struts, struts).

        The readings are the value of each sensor in SI, followed by its standard deviation where it
        has one. `loaded` is None where no model moves; then there are sensors of struts alone.
        """
        state = self._advance(state, t_ns, loaded, struts)
        known: list[float] = []
        if self._reader is not None:
            residual_n = [strut.force_n - strut.law_force_n for strut in struts]
            known = self._reader.read(loaded, residual_n)
            stds = self._no_stds
            # Not NaN: the observers know it.
            if self._shows_std and struts[0].force_std_n == struts[0].force_std_n:
                variances = ((state.gains @ covariance_n2()) * state.gains).sum(axis=1)
                stds = np.sqrt(variances).tolist()
            known = known + stds
        motions = zip(struts, state.powers_w, state.energies_j, strict=True)
        for strut, power_w, energy_j in motions:
            std_n = strut.force_std_n
            std_w = abs(strut.velocity_m_per_s) * std_n
            known += (strut.force_n, std_n, power_w, std_w, energy_j)
        return state, [known[index] for index in self._order]

    def _advance(
        self, state: SensedState | None, t_ns: int, loaded: Any, struts: Sequence[StrutOutput]
    ) -> SensedState:
        powers_w = tuple([-strut.force_n * strut.velocity_m_per_s for strut in struts])
        if state is None:
            gains = [] if self._reader is None else self._reader.force_gains(loaded)
            return SensedState(t_ns, np.array(gains), powers_w, (0.0,) * len(struts))
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
