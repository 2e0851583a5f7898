"""Springs whose force is not proportional to their deflection."""

import math
from functools import partial

from dart_model.effects.law import Effect, Motion, Parameter, Start
from dart_model.effects.ranges import always, grid, height, moving, of_stroke, within

_WIDE = "deflections from the free length that differ by a factor of three or more"
_LARGEST_EXPONENT = 40.0
_GAS = (
    Parameter(
        "gas_length_m",
        "m",
        1e-12,
        1e4,
        "ratio of gas volume to piston area (in a damper: to rod area), at the free length",
    ),
    Parameter("polytropic_exponent", "", 1.0, 3.0, "1: isothermal, 1.4: adiabatic (air)"),
)


def _quadratic(height_m: float, free_length_m: float, stiffness_n_per_m2: float) -> float:
    x = height_m - free_length_m
    return -stiffness_n_per_m2 * x * x


def _cubic(height_m: float, free_length_m: float, stiffness_n_per_m3: float) -> float:
    x = height_m - free_length_m
    return -stiffness_n_per_m3 * x * x * x


def _centred_cubic(height_m: float, stiffness_n_per_m3: float, centre_height_m: float) -> float:
    x = height_m - centre_height_m
    return -stiffness_n_per_m3 * x * x * x


def _power(
    height_m: float, free_length_m: float, force_at_100_mm_n: float, exponent: float
) -> float:
    x = height_m - free_length_m
    return -force_at_100_mm_n * math.copysign((abs(x) / 0.1) ** exponent, x)


def _progressive(height_m: float, free_length_m: float, force_n: float, length_m: float) -> float:
    ratio = (height_m - free_length_m) / length_m
    ratio = min(max(ratio, -_LARGEST_EXPONENT), _LARGEST_EXPONENT)
    return -force_n * (math.sinh(ratio) - ratio)


def _exponential(height_m: float, free_length_m: float, force_n: float, length_m: float) -> float:
    ratio = -(height_m - free_length_m) / length_m
    return force_n * (math.exp(min(ratio, _LARGEST_EXPONENT)) - 1.0)


def _gas(
    height_m: float,
    free_length_m: float,
    charge_force_n: float,
    gas_length_m: float,
    polytropic_exponent: float,
) -> float:
    length = max(gas_length_m + height_m - free_length_m, 0.01 * gas_length_m)
    return charge_force_n * (gas_length_m / length) ** polytropic_exponent


def _balanced_gas(
    height_m: float,
    free_length_m: float,
    charge_force_n: float,
    gas_length_m: float,
    polytropic_exponent: float,
) -> float:
    length = max(gas_length_m + height_m - free_length_m, 0.01 * gas_length_m)
    return charge_force_n * ((gas_length_m / length) ** polytropic_exponent - 1.0)


def _plateau(
    height_m: float, plateau_force_n: float, centre_height_m: float, half_width_m: float
) -> float:
    ratio = (height_m - centre_height_m) / half_width_m
    return -plateau_force_n * min(max(ratio, -1.0), 1.0)


@moving
def _lengths(motion: Motion) -> list[Start]:
    return grid([1.0], [share * motion.stroke_m for share in (0.1, 0.25, 0.6)])


@moving
def _plateau_starts(motion: Motion) -> list[Start]:
    widths = [share * motion.stroke_m for share in (0.02, 0.08, 0.18)]
    return grid([1.0], motion.heights_m(0.3, 0.4, 0.5, 0.6, 0.7), widths)


def _deepest_m(motion: Motion) -> float:
    return max(motion.free_length_m - motion.low_m, 0.25 * motion.stroke_m)


@moving
def _gas_starts(motion: Motion) -> list[Start]:
    lengths = [share * _deepest_m(motion) for share in (1.15, 1.5, 2.0, 4.0)]
    return grid([1.0], lengths, [1.0, 1.4])


def _gas_lengths(motion: Motion) -> tuple[float, float]:
    # The gas is not compressed to nothing; of one that is much longer, only the charge is felt.
    return 1.02 * _deepest_m(motion), 50.0 * _deepest_m(motion)


_spring = partial(Effect, family="nonlinear_stiffness", excitation=_WIDE)

QUADRATIC_STIFFNESS = _spring(
    name="quadratic_stiffness",
    words="a non-linear spring (quadratic)",
    parameters=(
        Parameter(
            "stiffness_n_per_m2",
            "N/m²",
            -1e18,
            1e18,
            "pull per squared deflection, on both sides of the free length",
        ),
    ),
    force=_quadratic,
    reference="Nayfeh and Mook, Nonlinear Oscillations (1979), 2.1",
    starts=always((1.0,)),
    simpler=("linear_stiffness",),
    shown=("stiffness_n_per_m2",),
)

CUBIC_STIFFNESS = _spring(
    name="cubic_stiffness",
    words="a non-linear spring (cubic, about the free length)",
    parameters=(
        Parameter(
            "stiffness_n_per_m3", "N/m³", -1e24, 1e24, "restoring force per cubed deflection"
        ),
    ),
    force=_cubic,
    reference="Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz (1918)",
    starts=always((1.0,)),
    simpler=("linear_stiffness",),
    shown=("stiffness_n_per_m3",),
    about_free_length=True,
)

CENTRED_CUBIC_STIFFNESS = _spring(
    name="centred_cubic_stiffness",
    words="a non-linear spring (cubic, about a centre height)",
    parameters=(
        Parameter(
            "stiffness_n_per_m3", "N/m³", -1e24, 1e24, "restoring force per cubed deflection"
        ),
        Parameter("centre_height_m", "m", -1e4, 1e4, "height at which the force is zero"),
    ),
    force=_centred_cubic,
    excitation="deflections from the centre that differ by a factor of three or more",
    reference="Nayfeh and Mook, Nonlinear Oscillations (1979), 2.1",
    starts=moving(lambda m: grid([1.0], m.heights_m(0.1, 0.3, 0.5, 0.7, 0.9))),
    bounds=within(centre_height_m=height(-1.0, 2.0)),
    simpler=("linear_stiffness", "cubic_stiffness", "quadratic_stiffness"),
    shown=("stiffness_n_per_m3",),
)

POWER_STIFFNESS = _spring(
    name="power_stiffness",
    words="a non-linear spring (power law)",
    parameters=(
        Parameter("force_at_100_mm_n", "N", -1e36, 1e36, "force at a compression of 100 mm"),
        Parameter("exponent", "", 1.2, 8.0, "exponent of the deflection"),
    ),
    force=_power,
    reference="Kovacic and Brennan, The Duffing Equation (2011), 1.3",
    starts=always((1.0, 1.5), (1.0, 2.5), (1.0, 3.5), (1.0, 5.0)),
    simpler=("linear_stiffness", "cubic_stiffness"),
    shown=("force_at_100_mm_n",),
    about_free_length=True,
)

PROGRESSIVE_STIFFNESS = _spring(
    name="progressive_stiffness",
    words="a non-linear spring (progressive)",
    parameters=(
        Parameter("force_n", "N", -1e12, 1e12, "force scale"),
        Parameter(
            "length_m",
            "m",
            1e-12,
            1e4,
            "deflection scale: below it the force is nearly cubic, well above it exponential",
        ),
    ),
    force=_progressive,
    reference="Kovacic and Brennan, The Duffing Equation (2011), 1.3",
    starts=_lengths,
    bounds=within(length_m=of_stroke(0.04, 4.0)),
    simpler=("linear_stiffness", "cubic_stiffness"),
    shown=("force_n",),
    about_free_length=True,
)

EXPONENTIAL_STIFFNESS = _spring(
    name="exponential_stiffness",
    words="a non-linear spring (exponential, like rubber)",
    parameters=(
        Parameter("force_n", "N", -1e12, 1e12, "force scale"),
        Parameter(
            "length_m",
            "m",
            1e-12,
            1e4,
            "compression over which the stiffness grows by a factor of e",
        ),
    ),
    force=_exponential,
    reference="Gent, Engineering with Rubber (2012), 3.2",
    starts=_lengths,
    bounds=within(length_m=of_stroke(0.04, 4.0)),
    simpler=("linear_stiffness", "quadratic_stiffness"),
    shown=("force_n",),
)

PLATEAU_STIFFNESS = _spring(
    name="plateau_stiffness",
    words="a spring with a plateau (preloaded)",
    parameters=(
        Parameter("plateau_force_n", "N", 1e-12, 1e12, "constant force on either side"),
        Parameter("centre_height_m", "m", -1e4, 1e4, "height at which the force is zero"),
        Parameter("half_width_m", "m", 1e-12, 1e4, "deflection from there to either plateau"),
    ),
    force=_plateau,
    excitation="a stroke across both ends of the stiff part",
    reference="Den Hartog, Mechanical Vibrations (1956), 8.3: set-up springs",
    starts=_plateau_starts,
    # Both knees lie within nine tenths of the stroke; with one alone it is a stop.
    bounds=within(centre_height_m=height(0.25, 0.75), half_width_m=of_stroke(0.002, 0.2)),
    simpler=("linear_stiffness",),
    shown=("plateau_force_n", "centre_height_m"),
)

GAS_SPRING = _spring(
    name="gas_spring",
    words="a gas spring (polytropic)",
    parameters=(
        Parameter("charge_force_n", "N", 0.0, 1e12, "force at the free length"),
        *_GAS,
    ),
    force=_gas,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.4",
    starts=_gas_starts,
    bounds=within(gas_length_m=_gas_lengths),
    simpler=("linear_stiffness", "quadratic_stiffness"),
    shown=("charge_force_n",),
)

BALANCED_GAS_SPRING = _spring(
    name="balanced_gas_spring",
    words="a gas spring (polytropic, balanced at the free length)",
    parameters=(
        Parameter(
            "charge_force_n",
            "N",
            0.0,
            1e12,
            "gas force at the free length, which a constant force balances",
        ),
        *_GAS,
    ),
    force=_balanced_gas,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.4",
    starts=_gas_starts,
    bounds=within(gas_length_m=_gas_lengths),
    simpler=("linear_stiffness", "quadratic_stiffness"),
    shown=("charge_force_n",),
)
