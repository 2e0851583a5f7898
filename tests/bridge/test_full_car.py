"""Four observers in a full car: what its heights tell, and each strut as if it stood alone."""

from functools import cache

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dart_model.plant import DartPlant
from dart_model.spec import parse_model
from rig.closed_loop.observability import Unknown, linear_model, observability
from rig.closed_loop.strut_response import linearise_at
from rig.observers.none import NoObserver
from tests.bridge.full_car import GRAVITY, FullCar
from tests.bridge.test_larger_systems import OBSERVER, RATE_HZ, follow, noisy, wrong

CAR = FullCar()
T_S = np.arange(5 * RATE_HZ) / RATE_HZ
LATER = slice(1500, None)
"""After the start, which the tyres' own dampers have to end: nobody measures them."""


def test_eight_heights_of_a_full_car_do_not_tell_eight_forces(tmp_path):
    """Body and wheels have seven coordinates: eight forces can be in balance with one another."""
    model = FullCar().model(tmp_path)
    forces = [Unknown(strut.name, i) for i, strut in enumerate(model.struts)]
    rest = [FullCar.tyre_free_m] * 4 + [FullCar.free_m] * 4
    linear = linear_model(DartPlant(model), rest)
    found = observability(linear, range(8), forces)
    assert found == ((), (), False)
    for left_out in range(8):
        seven = [force for force in forces if force.strut != left_out]
        assert observability(linear, range(8), seven) == ((), (), True)


def errors(plant, seen):
    """RMS errors of the suspensions' forces over the forces' deviations."""
    observers = (NoObserver("none"),) * 4 + (OBSERVER,) * 4
    forces_n = bench()[2]
    found = follow(plant, seen, np.array([CAR.load_n(t) for t in T_S]), observers)
    return rms((found - forces_n)[LATER, 4:]) / np.std(forces_n[LATER, 4:], axis=0)


@cache
def bench():
    """Heights, rates and forces of the bench."""
    return CAR.run(T_S)


def rms(values):
    return np.sqrt(np.mean(np.square(values), axis=0))


def seen():
    measured = noisy(bench()[0])
    measured[:, :4] = np.nan
    return measured


ALONE = """
name: alone
gravity_m_per_s2: 9.81
skeleton:
  bodies:
    - {{name: body, mass_kg: {mass_kg}, joint: {{type: prismatic, axis: [0, 0, 1], parent: world}}}}
struts:
  - name: strut
    between: [world, body]
    free_length_m: {free_length_m}
    stiffness_n_per_m: {stiffness}
    damping_n_s_per_m: {damping}
{effect}
"""


def error_alone(index, mass_kg, *, corrected, share):
    """The same strut on a bench of its own that moves it as the car does."""
    name = list(CAR.corners)[index]
    text = ALONE.format(
        mass_kg=mass_kg,
        free_length_m=CAR.free_m,
        stiffness=CAR.stiffness[name],
        damping=CAR.damping[name],
        effect="".join(CAR.effect(name)) if corrected else "",
    )
    place = 4 + index
    _, rates, forces_n = bench()
    acceleration = CubicSpline(T_S, rates[:, place]).derivative()(T_S)
    applied_n = mass_kg * (acceleration + GRAVITY) - forces_n[:, place]
    plant = wrong(parse_model(text, "alone"), share)
    found = follow(plant, seen()[:, place : place + 1], applied_n)
    missed = rms((found[:, 0] - forces_n[:, place])[LATER])
    return float(missed / np.std(forces_n[LATER, place]))


@pytest.mark.slow
@pytest.mark.parametrize("corrected", [False, True])
def test_each_strut_of_a_full_car_is_estimated_as_if_it_stood_alone(tmp_path, corrected):
    """Suspensions a third too weak and without their cubic spring; or corrected, as they are."""
    share = 1.0 if corrected else 0.7
    model = CAR.model(tmp_path, CAR.corners if corrected else ())
    suspensions = [f"suspension_{name}" for name in CAR.corners]
    plant = wrong(model, share, suspensions)
    found = errors(plant, seen())
    answers = linearise_at(plant, bench()[0][0]).responses()[4:]
    for index, (error, answer) in enumerate(zip(found, answers, strict=True)):
        alone = error_alone(index, 1.0 / answer.mobility_per_kg, corrected=corrected, share=share)
        assert error < 1.1 * alone
        assert error < 0.03
