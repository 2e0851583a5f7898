"""Springs whose force is not proportional to their deflection."""

import math

from dart_model.effects.contract import Effect, Floats, Parameter

_FAMILY = "nonlinear_stiffness"
_WIDE = "deflections from the free length that differ by a factor of three or more"
_LARGEST_EXPONENT = 40.0


def _quadratic(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    x = height_m - strut[0]
    return -p[0] * x * x


def _cubic(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    x = height_m - strut[0]
    return -p[0] * x * x * x


def _centred_cubic(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    x = height_m - p[1]
    return -p[0] * x * x * x


def _power(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    x = height_m - strut[0]
    return -p[0] * math.copysign((abs(x) / 0.1) ** p[1], x)


def _progressive(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    ratio = (height_m - strut[0]) / p[1]
    ratio = min(max(ratio, -_LARGEST_EXPONENT), _LARGEST_EXPONENT)
    return -p[0] * (math.sinh(ratio) - ratio)


def _exponential(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    ratio = -(height_m - strut[0]) / p[1]
    return p[0] * (math.exp(min(ratio, _LARGEST_EXPONENT)) - 1.0)


def _gas(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    length = max(p[1] + height_m - strut[0], 0.01 * p[1])
    return p[0] * (p[1] / length) ** p[2]


def _balanced_gas(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    length = max(p[1] + height_m - strut[0], 0.01 * p[1])
    return p[0] * ((p[1] / length) ** p[2] - 1.0)


QUADRATIC_STIFFNESS = Effect(
    name="quadratic_stiffness",
    family=_FAMILY,
    parameters=(
        Parameter("stiffness_n_per_m2", "N/m²", -1e8, 1e8, "force per squared deflection"),
    ),
    force=_quadratic,
    excitation=_WIDE,
    reference="Nayfeh and Mook, Nonlinear Oscillations (1979), 2.1",
)

CUBIC_STIFFNESS = Effect(
    name="cubic_stiffness",
    family=_FAMILY,
    parameters=(
        Parameter("stiffness_n_per_m3", "N/m³", -1e10, 1e10, "force per cubed deflection"),
    ),
    force=_cubic,
    excitation=_WIDE,
    reference="Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz (1918)",
)

CENTRED_CUBIC_STIFFNESS = Effect(
    name="centred_cubic_stiffness",
    family=_FAMILY,
    parameters=(
        Parameter("stiffness_n_per_m3", "N/m³", -1e10, 1e10, "force per cubed deflection"),
        Parameter("centre_height_m", "m", -10.0, 10.0, "height without force"),
    ),
    force=_centred_cubic,
    excitation=_WIDE,
    reference="Nayfeh and Mook, Nonlinear Oscillations (1979), 2.1",
)

POWER_STIFFNESS = Effect(
    name="power_stiffness",
    family=_FAMILY,
    parameters=(
        Parameter("force_at_100_mm_n", "N", -1e6, 1e6, "force at a deflection of 100 mm"),
        Parameter("exponent", "", 1.2, 8.0, "exponent of the deflection"),
    ),
    force=_power,
    excitation=_WIDE,
    reference="Kovacic and Brennan, The Duffing Equation (2011), 1.3",
)

PROGRESSIVE_STIFFNESS = Effect(
    name="progressive_stiffness",
    family=_FAMILY,
    parameters=(
        Parameter("force_n", "N", -1e5, 1e5, "force scale"),
        Parameter("length_m", "m", 0.005, 10.0, "deflection at which the spring stiffens"),
    ),
    force=_progressive,
    excitation=_WIDE,
    reference="Kovacic and Brennan, The Duffing Equation (2011), 1.3",
)

EXPONENTIAL_STIFFNESS = Effect(
    name="exponential_stiffness",
    family=_FAMILY,
    parameters=(
        Parameter("force_n", "N", -1e5, 1e5, "force scale"),
        Parameter("length_m", "m", 0.005, 10.0, "compression by which the force grows e-fold"),
    ),
    force=_exponential,
    excitation=_WIDE,
    reference="Gent, Engineering with Rubber (2012), 3.2",
)

GAS_SPRING = Effect(
    name="gas_spring",
    family=_FAMILY,
    parameters=(
        Parameter("charge_force_n", "N", -1e5, 1e5, "force at the free length"),
        Parameter("gas_length_m", "m", 0.02, 10.0, "gas volume over piston area at free length"),
        Parameter("polytropic_exponent", "", 1.0, 3.0, "1 isothermal, 1.4 adiabatic air"),
    ),
    force=_gas,
    excitation=_WIDE,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.4",
)

BALANCED_GAS_SPRING = Effect(
    name="balanced_gas_spring",
    family=_FAMILY,
    parameters=(
        Parameter("charge_force_n", "N", -1e5, 1e5, "charge, balanced at the free length"),
        Parameter("gas_length_m", "m", 0.02, 10.0, "gas volume over piston area at free length"),
        Parameter("polytropic_exponent", "", 1.0, 3.0, "1 isothermal, 1.4 adiabatic air"),
    ),
    force=_balanced_gas,
    excitation=_WIDE,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.4",
)
