"""A start for friction and the valves of a damper together, along the motion.

A damper law that rises steeply from rest imitates friction, and friction such a damper: from either
alone, or from both one after the other, a fit ends in the valley of the imitation. At given knees
the force of both is linear in its four sizes, so that these have no valley.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.problem.problem import StrutEffect
from rig.diagnosis.search.screen import (
    Screening,
    Stage,
    begin_round,
    law_starts,
    refine,
    scale_law,
)

Array = NDArray[np.float64]

_FRICTION, _DAMPER = "elastoplastic_friction", "valve_damping"
_KNEES = (0.15, 0.4, 1.0)
"""Velocities of the knees, as shares of the RMS velocity, that are tried in each direction."""
_SHARPNESS = 3.0
"""Of the knees at first, as in the starts of the law: between rounded (2) and sharp (12)."""


def screen_damper_with_friction(stage: Stage, base: Screening, strut: int) -> Screening | None:
    """A combination with friction and a damper with valves in a strut, refined along the motion.

    None where the motion shows no such friction.
    """
    at: tuple[StrutEffect, StrutEffect] = (strut, _FRICTION), (strut, _DAMPER)
    starts = law_starts(stage.problem, at[0], {})
    if not starts:
        return None
    values = _best_values(stage, base, at, starts[0])
    if values is None:
        return None
    return refine(stage, (*base.laws, *at), (*base.values, *values))


def _best_values(
    stage: Stage, base: Screening, at: tuple[StrutEffect, StrutEffect], dry: Array
) -> tuple[Array, Array] | None:
    """Parameters of friction and damper at the knees where they leave least."""
    this = begin_round(stage, base)
    speed = stage.problem.motions[at[1][0]].speed_m_per_s
    knees = [share * speed for share in _KNEES]

    (friction,) = this.columns(at[0], [dry]).T
    added, *zones = this.columns(
        at[1],
        [
            _valves((0.0, 1.0, 0.0), speed, speed),
            *(_valves((1.0, 0.0, 0.0), knee, knee) for knee in knees),
            *(_valves((0.0, 0.0, 1.0), knee, knee) for knee in knees),
        ],
    ).T
    compression, rebound = zones[: len(knees)], zones[len(knees) :]
    best, least = None, np.inf
    for i, j in itertools.product(range(len(knees)), repeat=2):
        columns = np.column_stack([friction, compression[i], added, rebound[j]])
        if not np.all(np.isfinite(columns)):
            continue
        sizes = np.linalg.lstsq(columns, this.residual, rcond=None)[0]
        cost = float(np.sum((this.residual - columns @ sizes) ** 2))
        scaled = scale_law(at[0][1], dry, float(sizes[0]))
        if cost < least and sizes[0] > 0.0 and scaled is not None:
            best, least = (scaled, _valves(sizes[1:].tolist(), knees[i], knees[j])), cost
    return best


def _valves(sizes: Sequence[float], compression_knee: float, rebound_knee: float) -> Array:
    """Parameters of the damper: lost in compression, added and lost in rebound, and the knees."""
    compression, added, rebound = sizes
    return np.array([compression, compression_knee, added, rebound, rebound_knee, _SHARPNESS])
