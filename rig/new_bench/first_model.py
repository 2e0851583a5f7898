"""The first model of a bench: one body on a straight guide, on a linear spring and damper.

It is the model to begin with, and known to be wrong: what it lacks is what a run shows. Stiffness
and damping come from a catalogue, or from a recording by `fit_linear`.

Modulating functions (Shinbrot, "On the analysis of linear and nonlinear systems", Trans. ASME 79,
1957) make the equation of motion one without derivatives of what was measured: multiplied by a
function that vanishes with its derivatives at both ends of a window and integrated by parts,

    m z'' = F - k z - c z' + p,      p = k L0 - m g

becomes m <phi'' z> = <phi F> - k <phi z> + c <phi' z> + p <phi>: linear in k, c and p.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError

Array = NDArray[np.float64]

GRAVITY_M_PER_S2 = 9.81
"""Standard gravity to the digits of a model file's default."""

ROUGH_DAMPING_RATIO = 0.2
"""Of a bench whose damper is unknown: a shock absorber in a vehicle has 0.2 to 0.4 (Dixon, "The
Shock Absorber Handbook", 2007), and too little is corrected as well as too much."""

_WINDOWS_S = (0.1, 0.2, 0.4, 0.8)
"""Lengths of windows: a period at 10 to 1.25 Hz, where struts are tested."""

_OVERLAP = 4
"""Windows that hold a sample, of one length."""

_FEWEST_SAMPLES = 16
"""In a window: its integrals are sums."""

_FEWEST_WINDOWS = 30
"""Ten equations for each of the three unknowns."""

_LEAST_EXPLAINED = 0.5
"""Share of the inertia's variance that the linear model explains, below which it is no model."""


@dataclass(frozen=True)
class LinearFit:
    """Linear spring and damper of a recording.

    Attributes:
        stiffness_n_per_m: With a mass of 1 kg that over the mass, 1/s².
        damping_n_s_per_m: Likewise, 1/s.
        rest_m: Height at which no force is left but the weight.
        explained: Share of the variance of the inertia force that they explain.
    """

    stiffness_n_per_m: float
    damping_n_s_per_m: float
    rest_m: float
    explained: float


@dataclass(frozen=True)
class FirstModel:
    """What is known of a bench before it runs.

    Attributes:
        mass_kg: Mass that moves with the strut's upper end.
        rest_m: Length of the strut at rest; None where only the free length is known.
        stated_free_length_m: Length of the strut without a force, by a drawing; None if it follows
            from the length at rest.
    """

    mass_kg: float
    rest_m: float | None
    stiffness_n_per_m: float
    damping_n_s_per_m: float
    stated_free_length_m: float | None = None

    @property
    def free_length_m(self) -> float:
        """Length of the strut without a force: the weight shortens it."""
        if self.stated_free_length_m is not None:
            return self.stated_free_length_m
        if self.rest_m is None:
            raise ValueError("expected a length at rest or a free length")
        return self.rest_m + self.mass_kg * GRAVITY_M_PER_S2 / self.stiffness_n_per_m

    @property
    def _source_of_length(self) -> str:
        if self.stated_free_length_m is not None:
            return "as stated"
        return f"{self.rest_m:g} m at rest, under the weight"

    def text(self, name: str, source: str) -> str:
        """YAML of the model.

        Args:
            name: Of the bench.
            source: Where stiffness and damping come from.
        """
        return (
            f"# A first model: linear spring and damper, {source}.\n"
            f"name: {name}\n"
            f"gravity_m_per_s2: {GRAVITY_M_PER_S2}   # 0 for a horizontal guide\n"
            "skeleton:\n"
            "  bodies:\n"
            f"    - {{name: body, mass_kg: {self.mass_kg:g}, "
            "joint: {type: prismatic, axis: [0, 0, 1], parent: world}}\n"
            "struts:\n"
            "  - name: strut\n"
            "    between: [world, body]\n"
            f"    free_length_m: {self.free_length_m:.6g}   # {self._source_of_length}\n"
            f"    stiffness_n_per_m: {self.stiffness_n_per_m:.6g}\n"
            f"    damping_n_s_per_m: {self.damping_n_s_per_m:.6g}\n"
            "    effects: []\n"
        )


def rough_damping_n_s_per_m(mass_kg: float, stiffness_n_per_m: float) -> float:
    """Damping of a bench whose damper is unknown."""
    return 2.0 * ROUGH_DAMPING_RATIO * math.sqrt(mass_kg * stiffness_n_per_m)


def fit_linear(
    t_s: Array, height_m: Array, applied_force_n: Array | None, mass_kg: float
) -> LinearFit:
    """Stiffness, damping and height at rest of a body that a strut carries.

    Args:
        t_s: Times, increasing, shape (N,).
        height_m: Heights at them, shape (N,).
        applied_force_n: Applied force at them, upwards; None for a free response.
        mass_kg: Mass of the body; 1 for mass-normalised results, where no force was measured.

    Raises:
        InputError: The recording is too short, hardly moves, or no linear spring and damper
            explains its motion.
    """
    force = np.zeros_like(height_m) if applied_force_n is None else applied_force_n
    centre_m = float(height_m.mean())
    blocks = [
        _windowed(t_s, height_m - centre_m, force, mass_kg, duration_s) for duration_s in _WINDOWS_S
    ]
    rows = np.concatenate([block[0] for block in blocks])
    inertia = np.concatenate([block[1] for block in blocks])
    if len(rows) < _FEWEST_WINDOWS:
        raise InputError(
            f"{len(rows)} windows of {_WINDOWS_S[0]:g} to {_WINDOWS_S[-1]:g} s with at least "
            f"{_FEWEST_SAMPLES} samples each, expected {_FEWEST_WINDOWS} or more: record some "
            "seconds of motion, 160 samples a second or more"
        )
    (stiffness, damping, offset), *_ = np.linalg.lstsq(rows, inertia, rcond=None)
    residual = inertia - rows @ np.array([stiffness, damping, offset])
    explained = 1.0 - float(residual.var() / inertia.var()) if inertia.var() > 0.0 else 0.0
    if explained < _LEAST_EXPLAINED or stiffness <= 0.0:
        raise InputError(
            f"a linear spring and damper explain {max(explained, 0.0):.0%} of the motion, with a "
            f"stiffness of {stiffness:.4g}: expected a recording in which the body moves freely "
            "on the strut, by the applied force or after it was let go"
        )
    return LinearFit(
        float(stiffness), max(float(damping), 0.0), centre_m + float(offset / stiffness), explained
    )


def _windowed(
    t_s: Array, height_m: Array, force_n: Array, mass_kg: float, duration_s: float
) -> tuple[Array, Array]:
    """Rows (-<phi z>, <phi' z>, <phi>) and left-hand sides m <phi'' z> - <phi F>, by windows.

    The function is sin^4: it vanishes at the ends with its first three derivatives.
    """
    starts = np.arange(t_s[0], t_s[-1] - duration_s, duration_s / _OVERLAP)
    rows: list[tuple[float, float, float]] = []
    inertia: list[float] = []
    weights_s = np.gradient(t_s)
    rate = math.pi / duration_s
    for start in starts:
        first, last = np.searchsorted(t_s, (start, start + duration_s))
        if last - first < _FEWEST_SAMPLES:
            continue
        window = slice(int(first), int(last))
        angle = rate * (t_s[window] - start)
        sine, cosine = np.sin(angle), np.cos(angle)
        phi = weights_s[window] * sine**4
        phi_1 = weights_s[window] * 4.0 * rate * sine**3 * cosine
        phi_2 = weights_s[window] * 4.0 * rate**2 * sine**2 * (3.0 * cosine**2 - sine**2)
        z, scale = height_m[window], float(phi.sum())
        rows.append((-float(phi @ z) / scale, float(phi_1 @ z) / scale, 1.0))
        inertia.append((mass_kg * float(phi_2 @ z) - float(phi @ force_n[window])) / scale)
    return np.array(rows).reshape(-1, 3), np.array(inertia)
