"""The linear dynamics along which laws are compared: from rest, forces in columns."""

import numpy as np
import pytest

from rig.diagnosis.problem.linear_dynamics import LinearDynamics
from rig.diagnosis.problem.mechanism import LinearisedMechanism

STEP_S, DURATION_S = 4e-3, 10.0


def mechanism(jacobian, mass):
    """Bodies on straight guides, all else zero."""
    struts, n = jacobian.shape
    nothing = {
        "q": (n,), "v": (n,), "heights_m": (struts,), "rates_m_per_s": (struts,), "inputs": (n, 1),
        "moved": (struts, 0), "bias": (n,), "bias_q": (n, n), "bias_v": (n, n),
        "mass_by_kg": (struts, n, n), "bias_by_kg": (struts, n), "inputs_by_kg": (struts, n, 1),
    }  # fmt: skip
    zeros = {name: np.zeros((1, *shape)) for name, shape in nothing.items()}
    return LinearisedMechanism(jacobian=jacobian[np.newaxis], mass=mass[np.newaxis], **zeros)


ONE = np.array([[1.0]]), np.array([[20.0]])
TWO = np.array([[1.0, 0.0], [-1.0, 1.0], [0.3, 0.5]]), np.array([[30.0, 2.0], [2.0, 12.0]])


@pytest.mark.parametrize(("jacobian", "mass"), [ONE, TWO])
def test_forces_in_columns_move_a_mechanism_as_each_does_alone(jacobian, mass):
    struts, n = jacobian.shape
    constants = np.tile([0.0, 18e3, 240.0, 0.0, 0.0], (struts, 1))
    dynamics = LinearDynamics(mechanism(jacobian, mass), constants, DURATION_S, STEP_S)
    rng = np.random.default_rng(3)
    samples = int(DURATION_S / (STEP_S / dynamics.finer))
    directions, forces = rng.normal(size=(samples, n)), rng.normal(size=(samples, 5))
    together = dynamics.heights(directions, forces)
    assert together.shape == (samples, struts, 5)
    for i in range(5):
        alone = dynamics.heights(directions, forces[:, i : i + 1])
        np.testing.assert_allclose(together[..., i], alone[..., 0], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(("jacobian", "mass"), [ONE, TWO])
@pytest.mark.parametrize("columns", [1, 3])
def test_a_constant_force_bends_the_springs_in_the_end(jacobian, mass, columns):
    struts = len(jacobian)
    constants = np.tile([0.0, 18e3, 240.0, 0.0, 0.0], (struts, 1))
    dynamics = LinearDynamics(mechanism(jacobian, mass), constants, DURATION_S, STEP_S)
    samples = int(DURATION_S / (STEP_S / dynamics.finer))
    sizes = 100.0 * np.arange(1, columns + 1)
    heights_m = dynamics.heights(np.tile(jacobian[0], (samples, 1)), np.tile(sizes, (samples, 1)))
    bent_m = jacobian @ np.linalg.solve(18e3 * jacobian.T @ jacobian, jacobian[0])
    np.testing.assert_allclose(heights_m[-1], np.outer(bent_m, sizes), rtol=1e-6)
