"""What virtual sensors show at a tick: variables of the model that follows the bench.

Bodies and joints move as the model does, under the estimated forces of the struts. Where an
observer states how well it knows a force, so is known what depends on it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from dart_model.protocol import AnySensorReader
from rig.bridge.estimator import AnyEstimator
from rig.bridge.motion_errors import MotionErrorTracker, TrackedErrors
from rig.bridge.values import StrutOutput

Array = NDArray[np.float64]

_OF_STRUT = {"force_of": (0, 1), "power_of": (2, 3), "energy_of": (4, None)}
"""Places of value and standard deviation among the numbers of a strut."""
_STRUT_NUMBERS = 5
"""Of each strut: force and power, each with its standard deviation, and energy."""


_NO_GAIN = 1e-9
"""Share of a sensor's largest gain that is rounding."""


class SensorPlace(NamedTuple):
    """What a virtual sensor reads.

    Attributes:
        kind: Its key, as of `dart_model.virtual_sensors`.
        strut: Index of the strut that it is of; -1 for a body or joint.
        known_by: What its standard deviation follows from, as of `SensedQuantity`; empty where none
            is shown.
    """

    kind: str
    strut: int
    known_by: str


class SensedState(Struct, frozen=True, gc=False):
    """What is remembered between two ticks.

    Attributes:
        products: Products of the changes of each sensor that forces change, by a newton in each
            strut where the model started, as of `products_of`.
        tracked: Errors of the sensors of motions; None where there are none.
        powers_w: Power that each strut took.
        energies_j: Energy that each strut has taken since the model started.
    """

    t_ns: int
    products: Array
    tracked: TrackedErrors | None
    powers_w: tuple[float, ...]
    energies_j: tuple[float, ...]


class VirtualSensors:
    """All virtual sensors of a run, in the order of its configuration.

    Args:
        sensors: What each reads.
        reader: Reads those of bodies and joints in their order; None where there are none.
        tracker: Tracks the errors of those of motions in their order; None where there are none.
    """

    def __init__(
        self,
        sensors: Sequence[SensorPlace],
        reader: AnySensorReader | None,
        tracker: MotionErrorTracker | None,
    ) -> None:
        self._reader, self._tracker = reader, tracker
        of_model = [sensor for sensor in sensors if sensor.strut < 0]
        self._by_force = [it for it, sensor in enumerate(of_model) if sensor.known_by == "force"]
        self._moving = [it for it, sensor in enumerate(of_model) if is_of_motion(sensor)]
        # Readings of the model, deviations by forces, deviations by heights, numbers of struts.
        of_force, of_height = iter(range(len(self._by_force))), iter(range(len(self._moving)))
        by_height, by_strut = len(of_model) + len(self._by_force), 2 * len(of_model)
        self._order: list[int] = []
        next_of_model = 0
        for sensor in sensors:
            if sensor.strut < 0:
                value = next_of_model
                next_of_model += 1
                if sensor.known_by == "force":
                    std = len(of_model) + next(of_force)
                else:
                    std = by_height + next(of_height)
            else:
                begin = by_strut + _STRUT_NUMBERS * sensor.strut
                at, at_std = _OF_STRUT[sensor.kind]
                value, std = begin + at, begin + (at_std or 0)
            self._order += [value, std] if sensor.known_by else [value]
        self._no_stds_by_force = [np.nan] * len(self._by_force)
        self._no_stds_by_height = [np.nan] * len(self._moving)

    @property
    def reads_model(self) -> bool:
        """Whether some are of bodies or joints, so that a model has to move."""
        return self._reader is not None

    def read(
        self,
        sensed: SensedState | None,
        t_ns: int,
        estimator: AnyEstimator,
        state: Any,
        struts: Sequence[StrutOutput],
    ) -> tuple[SensedState, list[float]]:
        """State and readings at a tick behind which the estimator has a state.

        The readings are the value of each sensor in SI, followed by its standard deviation where it
        has one. Where no model moves there are sensors of struts alone.
        """
        sensed = self._advance(sensed, t_ns, estimator, state, struts)
        known: list[float] = []
        if self._reader is not None:
            residual_n = [strut.force_n - strut.law_force_n for strut in struts]
            known = self._reader.read(estimator.model_of(state), residual_n)
            by_force = self._no_stds_by_force
            # Not NaN: an observer knows it.
            if by_force and any(strut.force_std_n == strut.force_std_n for strut in struts):
                by_force = stds_by_force(sensed.products, estimator.force_covariance_n2(state))
            tracked = sensed.tracked
            by_height = self._no_stds_by_height if tracked is None else tracked.errors.stds
            known = [*known, *by_force, *by_height]
        motions = zip(struts, sensed.powers_w, sensed.energies_j, strict=True)
        for strut, power_w, energy_j in motions:
            std_n = strut.force_std_n
            std_w = abs(strut.velocity_m_per_s) * std_n
            known += (strut.force_n, std_n, power_w, std_w, energy_j)
        return sensed, [known[index] for index in self._order]

    def _advance(
        self,
        sensed: SensedState | None,
        t_ns: int,
        estimator: AnyEstimator,
        state: Any,
        struts: Sequence[StrutOutput],
    ) -> SensedState:
        powers_w = tuple([-strut.force_n * strut.velocity_m_per_s for strut in struts])
        if sensed is None:
            return self._begin(t_ns, estimator.model_of(state), powers_w)
        half_s = 0.5e-9 * (t_ns - sensed.t_ns)
        energies_j = tuple(
            [
                energy_j + half_s * (before_w + now_w)
                for energy_j, before_w, now_w in zip(
                    sensed.energies_j, sensed.powers_w, powers_w, strict=True
                )
            ]
        )
        tracked = sensed.tracked
        if self._tracker is not None and tracked is not None:
            tracked = self._tracker.update(tracked, t_ns, estimator, state)
        return SensedState(t_ns, sensed.products, tracked, powers_w, energies_j)

    def _begin(self, t_ns: int, loaded: Any, powers_w: tuple[float, ...]) -> SensedState:
        """State at the first tick of a model."""
        products, tracked = np.zeros((0, 0)), None
        if self._reader is not None:
            products = products_of(np.array(self._reader.force_gains(loaded))[self._by_force])
        if self._tracker is not None:
            tracked = self._tracker.init(t_ns, loaded)
        return SensedState(t_ns, products, tracked, powers_w, (0.0,) * len(powers_w))


def products_of(gains: Array) -> Array:
    """Products of the gains of each sensor, shape (sensors, struts * struts)."""
    return (gains[:, :, None] * gains[:, None, :]).reshape(len(gains), -1)


def stds_by_force(products: Array, covariance_n2: Array) -> list[float]:
    """Standard deviations of sensors by those of forces; NaN where they depend on one unknown.

    `products` are those of the gains. What one sensor shows is the same bit for bit whatever others
    there are, as a matrix product would not be.
    """
    each = covariance_n2.ravel()
    variances: Array = (products * each).sum(axis=1)
    if np.isnan(variances).any():
        sizes = np.abs(products)
        depends = sizes[:, np.isnan(each)] > _NO_GAIN * sizes.max(axis=1)[:, None]
        variances = (products * np.nan_to_num(each)).sum(axis=1)
        variances[depends.any(axis=1)] = np.nan
    return np.sqrt(variances).tolist()


def is_of_motion(sensor: SensorPlace) -> bool:
    """Whether a sensor reads a position or rate of the model, known by heights or their rates."""
    return sensor.known_by in ("height", "rate")
