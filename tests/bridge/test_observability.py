"""Textbook cases of what heights can and cannot tell."""

import pytest

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model, parse_model
from rig.closed_loop.observability import Unknown, linear_model, observability

ONE = (0.3,)
TWO = (0.29, 0.35)


def reference():
    return linear_model(DartPlant(load_model(MODELS / "reference.yaml")), ONE)


def quarter_car():
    return linear_model(DartPlant(load_model(MODELS / "quarter_car.yaml")), TWO)


def force(strut, name="force"):
    return Unknown(f"{name} {strut}", strut)


def offset(strut):
    return Unknown(f"offset {strut}", strut, is_offset=True)


def test_a_strut_is_told_from_its_height():
    found = observability(reference(), [0], [force(0)])
    assert found == ((), (), True)


def test_spring_and_damper_are_not_told_apart():
    spring, damper = force(0, "spring"), force(0, "damper")
    found = observability(reference(), [0], [spring, damper])
    assert found.hidden == ()
    assert found.confused == ((spring, damper),)


def test_a_preload_is_not_told_from_an_offset_but_each_is_without_the_other():
    found = observability(reference(), [0], [force(0), offset(0)])
    assert found == ((), ((force(0), offset(0)),), False)
    assert observability(reference(), [0], [offset(0)]) == ((), (), True)


def test_two_struts_in_series_want_two_heights():
    car = quarter_car()
    assert observability(car, [0, 1], [force(0), force(1)]) == ((), (), True)
    for seen, unseen in ((0, 1), (1, 0)):
        # What rests on the other strut moves nothing in this one.
        found = observability(car, [seen], [force(0), force(1)])
        assert found == ((force(unseen),), (), True)


def test_offsets_of_two_sensors_are_told_where_the_forces_are_known():
    found = observability(quarter_car(), [0, 1], [offset(0), offset(1)])
    assert found == ((), (), True)


def test_two_bodies_that_share_nothing_do_not_accuse_one_another():
    text = """
name: two
gravity_m_per_s2: 9.81
skeleton:
  bodies:
    - {name: left, mass_kg: 10.0, joint: {type: prismatic, axis: [0, 0, 1], parent: world}}
    - name: right
      mass_kg: 3.0
      joint: {type: prismatic, axis: [0, 0, 1], parent: world, offset_m: [1, 0, 0]}
struts:
  - name: left
    between: [world, left]
    free_length_m: 0.5
    stiffness_n_per_m: 500.0
    damping_n_s_per_m: 100.0
    effects: []
  - name: right
    between: [world, right]
    free_length_m: 0.5
    stiffness_n_per_m: 900.0
    damping_n_s_per_m: 30.0
    effects: []
"""
    both = linear_model(DartPlant(parse_model(text, "two")), (0.4, 0.4))
    assert observability(both, [0, 1], [force(0), force(1)]) == ((), (), True)
    assert observability(both, [0], [force(0), force(1)]).hidden == (force(1),)


@pytest.mark.parametrize("stiffness", [1.0, 1e3, 1e5])
def test_stiffness_does_not_matter(stiffness):
    spec = load_model(MODELS / "reference.yaml")
    strut = spec.struts[0].model_copy(update={"stiffness_n_per_m": stiffness})
    changed = linear_model(DartPlant(spec.model_copy(update={"struts": (strut,)})), ONE)
    assert observability(changed, [0], [force(0)]) == ((), (), True)
    assert observability(changed, [0], [force(0), offset(0)]).confused
