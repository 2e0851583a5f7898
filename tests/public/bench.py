"""A bench with a cubic spring beside the reference model's, by an integrator of its own."""

import numpy as np
from scipy.integrate import solve_ivp

MASS_KG, STIFFNESS, DAMPING, FREE_M, CUBIC = 10.0, 500.0, 100.0, 0.5, 2.0e5


def heights(t_s: np.ndarray, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Applied force and height at given times."""

    def force(t):
        return 60.0 * np.sin(6.0 * t + phase) + 50.0 * np.sin(13.0 * t + 2.0 * phase)

    def slope(t, state):
        x = state[0] - FREE_M
        spring = -STIFFNESS * x - CUBIC * x**3 - DAMPING * state[1]
        return [state[1], (spring + force(t)) / MASS_KG - 9.81]

    found = solve_ivp(
        slope, (0.0, t_s[-1]), [0.42, 0.0], t_eval=t_s, rtol=1e-10, atol=1e-12, method="DOP853"
    )
    return force(t_s), found.y[0]
