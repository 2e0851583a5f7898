"""Delay between the channels: the force acts later than it was recorded, or heights come late."""

from dart_model.effects.law import Effect, Parameter, Rates, State

# Padé approximants of exp(-delay * s). An explicit integrator must follow their poles, so a short
# delay, which needs no more, has a low order and one more pole.
_POLE_PER_S = 2000.0
_SECOND_ORDER_FROM_S = 0.002
_FOURTH_ORDER_FROM_S = 0.006


def _pade_less_one(
    applied_force_n: float, lag_1: float, lag_2: float, lag_4: float, delay_s: float
) -> float:
    if delay_s < _SECOND_ORDER_FROM_S:
        pole = min(_POLE_PER_S, 2.0 / delay_s) if delay_s > 0.0 else _POLE_PER_S
        return -delay_s * pole * (applied_force_n - lag_1)
    if delay_s < _FOURTH_ORDER_FROM_S:
        # (12 - 6 u + u²) / (12 + 6 u + u²) - 1 with u = delay * s
        return -12.0 / delay_s * lag_2
    # (1680 - 840 u + 180 u² - 20 u³ + u⁴) / (1680 + 840 u + 180 u² + 20 u³ + u⁴) - 1
    return -(1680.0 * lag_2 + 40.0 * lag_4)


def _pade_rates(
    applied_force_n: float, lag_1: float, lag_2: float, lag_3: float, lag_4: float, delay_s: float
) -> Rates:
    if delay_s < _SECOND_ORDER_FROM_S:
        pole = min(_POLE_PER_S, 2.0 / delay_s) if delay_s > 0.0 else _POLE_PER_S
        return pole * (applied_force_n - lag_1), 0.0, 0.0, 0.0
    if delay_s < _FOURTH_ORDER_FROM_S:
        rise = applied_force_n - (12.0 / delay_s * lag_1 + 6.0 * lag_2) / delay_s
        return lag_2, rise, 0.0, 0.0
    # States are scaled by powers of the delay, so that all are of the order of the force.
    highest = 1680.0 * lag_1 + 840.0 * lag_2 + 180.0 * lag_3 + 20.0 * lag_4
    rise = (applied_force_n - highest) / delay_s
    return lag_2 / delay_s, lag_3 / delay_s, lag_4 / delay_s, rise


DELAY = Effect(
    name="delay",
    family="delay",
    words="a delay between applied force and height",
    parameters=(
        Parameter("delay_s", "s", 0.0, 1e3, "time by which the height lags the applied force"),
    ),
    force=_pade_less_one,
    excitation=(
        "an applied force with frequencies high enough that the delay is a clear part of a period, "
        "or with frequent steps"
    ),
    reference="Golub and Van Loan, Matrix Computations (2013), 9.3, Padé approximation",
    rate=_pade_rates,
    scaled=(),
    states=tuple(State(f"lag_{i}", 0.01) for i in (1, 2, 3, 4)),
    fits_state=True,
    benches=("force_given",),
    shown=("delay_s",),
    linear=True,
)
