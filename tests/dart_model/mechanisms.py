"""Planar mechanisms with closed loops: their models, and the same in one minimal coordinate.

The minimal coordinate is the angle of the lower arm in the plane of y and z. Where the bodies are
follows from it in closed form, and Lagrange's equation of second kind from that by differences: no
constraint, no multiplier, and no code of the model.
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

GRAVITY = 9.81
TICK_S = 5e-4
LOWER, PIVOT = 0.40, (0.06, 0.28)
"""Length of the double wishbone's lower arm, and where its upper one turns (y, z), in m."""
_STEP = 2e-3
"""Of differences of fourth order, in rad."""


class Body(NamedTuple):
    name: str
    mass_kg: float
    moment_kg_m2: float


class Mechanism(NamedTuple):
    """A mechanism of one degree of freedom, with a strut between two points.

    Attributes:
        places: Angle -> (y, z, angle) of each body's centre of mass, shape (bodies, 3).
        strut_m: Angle -> length of the strut.
        applied_m: Angle -> height of the point on which the applied force acts.
        content: The model, as of YAML; its coordinates are zero at the angle zero.
        undeclared_n: Length and its rate of change -> what the strut's force has that the model
            lacks.
    """

    bodies: tuple[Body, ...]
    places: Callable[[float], np.ndarray]
    strut_m: Callable[[float], float]
    applied_m: Callable[[float], float]
    content: dict
    undeclared_n: Callable[[float, float], float] = lambda _length_m, _rate: 0.0

    def slope(self, function, theta):
        """Derivative by the angle, of fourth order."""
        near = function(theta + _STEP) - function(theta - _STEP)
        far = function(theta + 2 * _STEP) - function(theta - 2 * _STEP)
        return (8.0 * near - far) / (12.0 * _STEP)

    def inertia(self, theta):
        rates = self.slope(self.places, theta)
        return sum(
            body.mass_kg * (y * y + z * z) + body.moment_kg_m2 * turn * turn
            for body, (y, z, turn) in zip(self.bodies, rates, strict=True)
        )

    def acceleration(self, theta, rate, applied_n):
        """Second derivative of the angle under a force on the upright."""
        strut = self.content["struts"][0]
        lever, length = self.slope(self.strut_m, theta), self.strut_m(theta)
        force = -strut["stiffness_n_per_m"] * (length - strut["free_length_m"])
        force += self.undeclared_n(length, lever * rate) - strut["damping_n_s_per_m"] * lever * rate
        heights = self.slope(self.places, theta)[:, 1]
        weight = -GRAVITY * sum(b.mass_kg * h for b, h in zip(self.bodies, heights, strict=True))
        drive = applied_n * self.slope(self.applied_m, theta)
        bent = 0.5 * self.slope(self.inertia, theta) * rate * rate
        return (force * lever + weight + drive - bent) / self.inertia(theta)

    def strut_acceleration(self, theta, rate, applied_n):
        """Second derivative of the strut's length."""
        curved = self.slope(lambda at: self.slope(self.strut_m, at), theta)
        bent = curved * rate * rate
        return self.slope(self.strut_m, theta) * self.acceleration(theta, rate, applied_n) + bent


def double_wishbone() -> Mechanism:
    """Arms on pivots of the chassis, an upright between their ball joints; the upper one closes."""
    lower, upper, upright = LOWER, 0.32, 0.30
    pivot, top, on_arm = np.array(PIVOT), np.array([0.15, 0.55]), 0.30
    bodies = (Body("lower", 5.0, 0.3), Body("upright", 30.0, 0.8), Body("upper", 3.0, 0.2))

    def points(theta):
        low = lower * _unit(theta)
        gap = pivot - low
        d = math.hypot(*gap)
        along = (upright**2 - upper**2 + d**2) / (2 * d)
        across = math.sqrt(upright**2 - along**2)
        return low, low + (along * gap + across * np.array([gap[1], -gap[0]])) / d

    start = points(0.0)[1]
    straight = [
        math.atan2(*(end - begin)[::-1]) for begin, end in ((points(0.0)[0], start), (pivot, start))
    ]

    def places(theta):
        low, high = points(theta)
        turns = (
            theta,
            math.atan2(*(high - low)[::-1]) - straight[0],
            math.atan2(*(high - pivot)[::-1]) - straight[1],
        )
        return np.column_stack([np.array([[0.0, 0.0], low, pivot]), turns])

    content = _model(
        bodies,
        [
            _joint("revolute", "world", [0, 0, 0]),
            _joint("revolute", "lower", [0, lower, 0]),
            _joint("revolute", "world", [0, *pivot.tolist()]),
        ],
        {"between": ["upper", "upright"], "at": [0, *(start - pivot).tolist()], "type": "ball"},
        {
            "between": ["lower", "world"],
            "attachments_m": [[0, on_arm, 0], [0, *top.tolist()]],
            "free_length_m": 0.58,
        },
    )
    return Mechanism(
        bodies,
        places,
        lambda theta: math.hypot(*(top - on_arm * _unit(theta))),
        lambda theta: lower * math.sin(theta),
        content,
    )


def macpherson() -> Mechanism:
    """An arm, and an upright that slides on a rod below the top mount; the lower ball closes."""
    lower, top = 0.38, np.array([0.28, 0.60])
    axis = np.array([0.12, -0.58]) / math.hypot(0.12, 0.58)
    across = np.array([-axis[1], axis[0]])
    start = lower * _unit(0.0) - top
    reach, beside = float(start @ axis), float(start @ across)
    on_rod = 0.35
    straight = math.atan2(*start[::-1])
    bodies = (Body("arm", 6.0, 0.35), Body("rod", 2.0, 0.15), Body("upright", 28.0, 0.7))

    def slid(theta):
        """How far the upright slides down the rod, and the angle of the rod."""
        gap = lower * _unit(theta) - top
        along = math.sqrt(float(gap @ gap) - beside**2)
        turn = math.atan2(*gap[::-1]) - straight
        turn -= math.atan2(beside, along) - math.atan2(beside, reach)
        return along - reach, turn

    def places(theta):
        slide, turn = slid(theta)
        c, s = math.cos(turn), math.sin(turn)
        turned = np.array([[c, -s], [s, c]]) @ axis
        return np.array(
            [
                [0.0, 0.0, theta],
                [*top, turn],
                [*(top + (on_rod + slide) * turned), turn],
            ]
        )

    content = _model(
        bodies,
        [
            _joint("revolute", "world", [0, 0, 0]),
            _joint("revolute", "world", [0, *top.tolist()]),
            _joint("prismatic", "rod", [0, *(on_rod * axis).tolist()], [0, *axis.tolist()]),
        ],
        {"between": ["arm", "upright"], "at": [0, lower, 0], "type": "ball"},
        {
            "between": ["upright", "world"],
            "attachments_m": [[0, 0, 0], [0, *top.tolist()]],
            "free_length_m": 0.37,
        },
    )
    return Mechanism(
        bodies,
        places,
        lambda theta: on_rod + slid(theta)[0],
        lambda theta: float(places(theta)[2, 1]),
        content,
    )


STOP_N_PER_M = 150_000.0
CONTACT_M = {double_wishbone: 0.545, macpherson: 0.335}
"""Length of the strut at which a bump stop acts that a model lacks, by the mechanism's maker."""


def with_stop(make) -> Mechanism:
    """A mechanism with a linear bump stop in parallel with its strut."""
    contact_m = CONTACT_M[make]
    return make()._replace(
        undeclared_n=lambda length_m, _rate: STOP_N_PER_M * max(0.0, contact_m - length_m)
    )


def _unit(angle):
    return np.array([math.cos(angle), math.sin(angle)])


def _joint(kind, parent, offset_m, axis=(1, 0, 0)):
    return {"type": kind, "parent": parent, "offset_m": list(offset_m), "axis": list(axis)}


def _model(bodies, joints, loop, strut):
    return {
        "name": "corner",
        "gravity_m_per_s2": GRAVITY,
        "skeleton": {
            "bodies": [
                {
                    "name": body.name,
                    "mass_kg": body.mass_kg,
                    "inertia_kg_m2": [body.moment_kg_m2] * 3,
                    "joint": joint,
                }
                for body, joint in zip(bodies, joints, strict=True)
            ],
            "loops": [loop],
        },
        "struts": [
            {
                "name": "strut",
                "stiffness_n_per_m": 40_000.0,
                "damping_n_s_per_m": 1500.0,
                "carries": "upright",
            }
            | strut
        ],
        "applied_force_body": "upright",
    }


# --- motions --------------------------------------------------------------------------------------

CORNERS_S = np.arange(0.0, 20.05, 0.1)
CORNERS_N = np.random.default_rng(3).uniform(-2000.0, 2000.0, len(CORNERS_S))


def applied(t):
    """A force that is linear between its corners, as it is to the plant between ticks."""
    return float(np.interp(t, CORNERS_S, CORNERS_N))


def exact_angles(mechanism, times, force=applied, rtol=1e-10):
    """Angles from rest at zero, integrated from corner to corner of the force."""
    state, angles = [0.0, 0.0], []
    for begin, end in itertools.pairwise(CORNERS_S):
        inside = times[(times >= begin - 1e-9) & (times < end - 1e-9)]
        if not len(inside):
            break
        found = solve_ivp(
            lambda t, x: [x[1], mechanism.acceleration(x[0], x[1], force(t))],
            (begin, end),
            state,
            method="DOP853",
            rtol=rtol,
            atol=0.1 * rtol,
            dense_output=True,
        )
        angles += found.sol(inside)[0].tolist()
        state = found.y[:, -1]
    return np.array(angles)


def run(plant, start_m, duration_s):
    """States of a plant under the same force, tick by tick."""
    state = plant.init([start_m])
    states = [state]
    for k in range(round(duration_s / TICK_S) - 1):
        loaded = plant.load(state, (0.0,), (applied(k * TICK_S),), 23.0)
        state = plant.step(loaded, TICK_S, (applied((k + 1) * TICK_S),))
        states.append(state)
    return states
