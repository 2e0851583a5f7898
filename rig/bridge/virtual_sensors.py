"""What virtual sensors show at a tick: variables of the model that follows the bench.

Bodies and joints move as the model does, under the estimated forces of the struts. Where an
observer states how well it knows these forces and the motion, so is known what depends on them.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from msgspec import Struct

from dart_model.protocol import AnySensorReader
from rig.bridge.estimator import AnyEstimator
from rig.bridge.sensor_errors import SensorGains
from rig.bridge.values import StrutOutput

_OF_STRUT = {"force_of": (0, 1), "power_of": (2, 3), "energy_of": (4, None)}
"""Places of value and standard deviation among the numbers of a strut."""
_STRUT_NUMBERS = 5
"""Of each strut: force and power, each with its standard deviation, and energy."""


class SensorPlace(NamedTuple):
    """What a virtual sensor reads.

    Attributes:
        kind: Its key, as of `dart_model.virtual_sensors`.
        strut: Index of the strut that it is of; -1 for a body or joint.
        known_by: What its standard deviation, which is shown, too, follows from, as of
            `dart_model.virtual_sensors.SensedQuantity`; empty where it has none.
    """

    kind: str
    strut: int
    known_by: str


class SensedState(Struct, frozen=True, gc=False):
    """What is remembered between two ticks.

    Attributes:
        gains: Gains of the errors of the model's sensors; None where nothing is known of them.
        powers_w: Power that each strut took.
        energies_j: Energy that each strut has taken since the model started.
    """

    t_ns: int
    gains: SensorGains | None
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
        self._follows_motion = [it.known_by == "motion" for it in sensors if it.strut < 0]
        of_model = len(self._follows_motion)
        self._no_stds = [math.nan] * of_model
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
            self._order += [value, std] if sensor.known_by else [value]

    @property
    def reads_model(self) -> bool:
        """Whether some are of bodies or joints, so that a model has to move."""
        return self._reader is not None

    def read(
        self,
        before: SensedState | None,
        t_ns: int,
        estimator: AnyEstimator,
        state: Any,
        struts: Sequence[StrutOutput],
    ) -> tuple[SensedState, list[float]]:
        """State and readings at a tick at whose end the estimator has a state.

        The struts act as estimated. The readings are the value of each sensor in SI, followed by
        its standard deviation where it has one. If no model moves, there are sensors of struts
        alone.
        """
        sensed = self._advance(before, t_ns, estimator, state, struts)
        known: list[float] = []
        if self._reader is not None:
            residual_n = [strut.force_n - strut.law_force_n for strut in struts]
            known, stds = self._reader.read(estimator.model_of(state), residual_n), self._no_stds
            if sensed.gains is not None:
                errors = estimator.sensor_errors(state, sensed.gains)
                known, stds = (errors.corrections + known).tolist(), errors.stds.tolist()
            known += stds
        motions = zip(struts, sensed.powers_w, sensed.energies_j, strict=True)
        for strut, power_w, energy_j in motions:
            std_n = strut.force_std_n
            std_w = abs(strut.velocity_m_per_s) * std_n
            known += (strut.force_n, std_n, power_w, std_w, energy_j)
        return sensed, [known[index] for index in self._order]

    def _advance(
        self,
        before: SensedState | None,
        t_ns: int,
        estimator: AnyEstimator,
        state: Any,
        struts: Sequence[StrutOutput],
    ) -> SensedState:
        powers_w = tuple([-strut.force_n * strut.velocity_m_per_s for strut in struts])
        if before is None:
            gains = None
            if self._reader is not None:
                gains = estimator.sensor_gains(state, self._reader, self._follows_motion)
            return SensedState(t_ns, gains, powers_w, (0.0,) * len(struts))
        half_s = 0.5e-9 * (t_ns - before.t_ns)
        energies_j = tuple(
            [
                energy_j + half_s * (before_w + now_w)
                for energy_j, before_w, now_w in zip(
                    before.energies_j, before.powers_w, powers_w, strict=True
                )
            ]
        )
        return SensedState(t_ns, before.gains, powers_w, energies_j)
