"""The slopes of a strut's law where the model is."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model, parse_model


def with_effects(*effects):
    text = (MODELS / "reference.yaml").read_text()
    listed = ", ".join(effects)
    return DartPlant(parse_model(text.replace("effects: []", f"effects: [{listed}]"), "a test"))


CUBIC = "{name: cubic_stiffness, parameters: {stiffness_n_per_m3: 2.0e5}}"
QUADRATIC = "{name: quadratic_damping, parameters: {damping_n_s2_per_m2: 300.0}}"


@given(st.floats(0.35, 0.65), st.floats(-2.0, 2.0))
def test_they_are_those_of_spring_and_damper_with_the_effects(height_m, velocity):
    plant = with_effects(CUBIC, QUADRATIC)
    ((stiffness, damping),) = plant.slopes(plant.init([height_m], [velocity]), (0.0,), 20.0)
    x = height_m - 0.5
    # A secant of a cubic and of v |v|, over 1 mm and 0.05 m/s to each side.
    assert stiffness == pytest.approx(500.0 + 2e5 * (3.0 * x**2 + 1e-6), rel=1e-6)
    if abs(velocity) > 0.05:
        assert damping == pytest.approx(100.0 + 600.0 * abs(velocity), rel=1e-6)


def test_a_linear_model_has_the_same_everywhere():
    plant = DartPlant(load_model(MODELS / "reference.yaml"))
    assert plant.slopes(plant.init([0.4]), (0.0,), 20.0) is None


def test_dry_friction_is_a_secant_at_rest():
    friction = (
        "{name: coulomb_friction, parameters: "
        "{coulomb_force_n: 20.0, rounding_velocity_m_per_s: 1.0e-4}}"
    )
    plant = with_effects(friction)
    ((_, damping),) = plant.slopes(plant.init([0.4]), (0.0,), 20.0)
    assert damping == pytest.approx(100.0 + 20.0 / 0.05, rel=1e-3)
