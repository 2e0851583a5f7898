"""Delay between the channels: the force acts later than it was recorded, or heights come late."""

from dart_model.effects.law import Effect, Floats, Motion, Parameter, Start, Writable
from dart_model.effects.ranges import moving, within

# Padé approximants of exp(-delay * s). An explicit integrator must follow their poles, so a short
# delay, which needs no more, has a low order and a pole of its own.
_POLE_PER_S = 2000.0
_SECOND_ORDER_FROM_S = 0.002
_FOURTH_ORDER_FROM_S = 0.006


def _force(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    delay = p[0]
    if delay < _SECOND_ORDER_FROM_S:
        pole = min(_POLE_PER_S, 2.0 / delay) if delay > 0.0 else _POLE_PER_S
        return -delay * pole * (applied_force_n - state[0])
    if delay < _FOURTH_ORDER_FROM_S:
        # (12 - 6 u + u²) / (12 + 6 u + u²) - 1 with u = delay * s
        return -12.0 / delay * state[1]
    # (1680 - 840 u + 180 u² - 20 u³ + u⁴) / (1680 + 840 u + 180 u² + 20 u³ + u⁴) - 1
    return -(1680.0 * state[1] + 40.0 * state[3])


def _rate(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    delay = p[0]
    out[0] = 0.0
    out[1] = 0.0
    out[2] = 0.0
    out[3] = 0.0
    if delay < _SECOND_ORDER_FROM_S:
        pole = min(_POLE_PER_S, 2.0 / delay) if delay > 0.0 else _POLE_PER_S
        out[0] = pole * (applied_force_n - state[0])
    elif delay < _FOURTH_ORDER_FROM_S:
        out[0] = state[1]
        out[1] = applied_force_n - (12.0 / delay * state[0] + 6.0 * state[1]) / delay
    else:
        # States are scaled by powers of the delay, so that all stay near the size of the force.
        out[0] = state[1] / delay
        out[1] = state[2] / delay
        out[2] = state[3] / delay
        highest = 1680.0 * state[0] + 840.0 * state[1] + 180.0 * state[2] + 20.0 * state[3]
        out[3] = (applied_force_n - highest) / delay


@moving
def _starts(motion: Motion) -> list[Start]:
    return [(steps * motion.step_s,) for steps in (0.5, 2.0, 5.0, 15.0, 40.0)]


DELAY = Effect(
    name="delay",
    family="delay",
    words="a delay between applied force and height",
    parameters=(
        Parameter("delay_s", "s", 0.0, 1e3, "time by which the height lags the applied force"),
    ),
    force=_force,
    excitation="an applied force with frequencies near the inverse of the delay, or changing often",
    reference="Golub and Van Loan, Matrix Computations (2013), 9.3, Padé approximation",
    rate=_rate,
    scaled=(),
    state_scales=(0.01, 0.01, 0.01, 0.01),
    fits_state=True,
    starts=_starts,
    bounds=within(delay_s=lambda m: (0.0, 200.0 * m.step_s)),
    benches=("force_given",),
    shown=("delay_s",),
)
