"""Errors of virtual sensors of bodies and joints, by what makes them.

An acceleration, reaction or torque errs as the forces of the struts do. A position or rate errs as
the motion of the model does: what the observers know of that is corrected, what they do not know is
its standard deviation.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.bridge.tracked_motion import ErrorGains
from rig.closed_loop.sensor_response import SensorResponse
from rig.observers.protocol import EstimateErrors

Array = NDArray[np.float64]


class SensorGains(NamedTuple):
    """Gains of the errors of some sensors, where the model started.

    Attributes:
        by_motion: Readings by the mean errors as of `rig.observers.protocol.EstimateErrors`, shape
            (sensors, 2 known); zero of what errs as forces do, or is not determined.
        by_covariance: Variances by the numbers of the errors' covariance, shape (sensors, n²).
        by_inputs: Variances by noise and lag of the motions among the inputs, over the squares as
            of `rig.bridge.measured_inputs.MeasuredInput.squares_m2`, shape (sensors, 2 motions).
        unknown: NaN of a sensor that errs as the motion does and that the known heights and rates
            do not determine; zero elsewhere.
    """

    by_motion: Array
    by_covariance: Array
    by_inputs: Array
    unknown: Array


class SensorErrors(NamedTuple):
    """What is known of the errors of some sensors.

    Attributes:
        corrections: What is to be added to each reading of the model.
        stds: Standard deviation of each; NaN where it is not known.
    """

    corrections: Array
    stds: Array


def make_gains(
    follows_motion: Sequence[bool],
    by_force: Sequence[Sequence[float]],
    response: SensorResponse,
    motions: Sequence[ErrorGains],
    force_errors: Array,
) -> SensorGains:
    """Gains of sensors.

    Args:
        follows_motion: Whether each errs as the model's motion does, and not as the forces do.
        by_force: Change of each by a newton in each strut, shape (sensors, struts).
        response: How the sensors respond to heights and rates of the struts with known errors.
        motions: Errors of each motion among the inputs.
        force_errors: Covariances of the struts' forces by noise and lag of each of these, over
            their squares, shape (2 motions, struts²).
    """
    follows = np.array(follows_motion)
    is_determined = response.is_determined
    forces = np.array(by_force) * ~follows[:, None]
    by_motion = response.by_heights * (follows & is_determined)[:, None]
    each = np.hstack([forces, by_motion])
    of_forces = _products(forces) @ force_errors.reshape(-1, forces.shape[1] ** 2).T
    of_motion: list[Array] = []
    for index, gains in enumerate(motions):
        # The struts keep their measured heights: what hangs on them follows a position that lags.
        # White noise is too fast for that, and a wrong velocity is none of the heights.
        direct, followed = response.by_inputs[index], response.with_inputs[index]
        late = followed[:, 0] * gains.lag[0] + direct[:, 1] * gains.lag[1]
        of_motion += [((direct @ gains.noise) * direct).sum(axis=1), np.square(late)]
    rows = np.reshape(of_motion, (2 * len(motions), len(follows))).T * follows[:, None]
    unknown = np.where(follows & ~is_determined, np.nan, 0.0)
    return SensorGains(by_motion, _products(each), of_forces + rows, unknown)


def _products(gains: Array) -> Array:
    """Variances by the numbers of a covariance, row by row, from gains of shape (sensors, n)."""
    return np.einsum("si,sj->sij", gains, gains).reshape(len(gains), -1)


def find_errors(
    gains: SensorGains, errors: EstimateErrors, squares_m2: Sequence[float]
) -> SensorErrors:
    """Errors of sensors by those of an estimate; squares are of the motions among the inputs."""
    variances = gains.by_covariance.dot(errors.covariance)
    variances += gains.unknown
    if squares_m2:
        variances += gains.by_inputs.dot(squares_m2)
    return SensorErrors(gains.by_motion.dot(errors.mean), np.sqrt(variances))
