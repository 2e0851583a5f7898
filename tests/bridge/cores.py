"""Estimators, supervisors and inputs that the tests of this folder share."""

from collections.abc import Sequence

from dart_model.plant import DartPlant
from dart_model.protocol import AnyPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.free_model import FreeModelEstimator, SettlingTimes
from rig.bridge.measured_inputs import HeldInput
from rig.bridge.mode_supervisor import SupervisedState, Supervision, Supervisor
from rig.bridge.values import StepInput, StepOutput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    HEIGHT,
    LOAD_CELL_FORCE,
    TEMPERATURE,
    Quantity,
)
from rig.observers.pi import PiObserver
from rig.observers.protocol import AnyObserver

MS = 1_000_000


def gains(proportional: float, integral: float, limit_n: float = 5000.0) -> PiObserver:
    """A PI observer."""
    return PiObserver(
        proportional_n_per_m=proportional, integral_n_per_m_s=integral, force_limit_n=limit_n
    )


GAINS = gains(1e5, 1e4)
MEASURED = (APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE)
"""Quantities of the bench that the channels here have."""

SUPERVISION = Supervision(stale_after_s=0.01, safe_after_s=0.5)


FIRST = GAINS.measurements_to_start
"""Measurements from which a model starts, at the tick of the last of them."""


def settle_at_once(observers: Sequence[AnyObserver]) -> Sequence[int | None]:
    """Estimates that are valid from the start: the tests of the arithmetic are not about settling.

    An observer that knows its variance still has to settle with it.
    """
    return [0] * len(observers)


def channels(
    struts: int,
    *,
    interval_ns: int | Sequence[int] = MS,
    delay_ns: int | Sequence[int] = 0,
    measured: Sequence[int] | None = None,
    sensors: Sequence[Channel] = (),
) -> list[Channel]:
    """Channels of a bench: heights of struts, every quantity of the bench, further sensors."""
    intervals = [interval_ns] * struts if isinstance(interval_ns, int) else interval_ns
    delays = [delay_ns] * struts if isinstance(delay_ns, int) else delay_ns
    made: list[Channel] = []
    for strut in range(struts) if measured is None else measured:
        made.append(
            Channel(
                len(made),
                Role.HEIGHT,
                HEIGHT,
                f"strut{strut}",
                f"signals.height.strut{strut}",
                strut,
                intervals[strut],
                delays[strut],
            )
        )
    for quantity in MEASURED:
        key = f"signals.{quantity.key}"
        role = Role.INPUT if quantity is APPLIED_FORCE else Role.BENCH
        made.append(Channel(len(made), role, quantity, quantity.key, key, -1, MS))
    return [*made, *sensors]


def applied_force(bench: Sequence[Channel]) -> list[HeldInput]:
    """The inputs of a model that a single force drives."""
    return [HeldInput(next((it for it in bench if it.role is Role.INPUT), None))]


def supervised(
    plant: AnyPlant,
    observers: Sequence[AnyObserver],
    supervision: Supervision = SUPERVISION,
    bench: Sequence[Channel] | None = None,
    settling_times: SettlingTimes = settle_at_once,
) -> Supervisor:
    """A supervised estimator of a model."""
    bench = channels(plant.struts) if bench is None else bench
    estimator = FreeModelEstimator(
        plant,
        observers,
        bench,
        applied_force(bench),
        supervision.stale_after_ns,
        settling_times,
    )
    return Supervisor(estimator, supervision, [supervision.limits] * plant.struts)


def core(
    model: str = "reference",
    observer: PiObserver = GAINS,
    supervision: Supervision = SUPERVISION,
    settling_times: SettlingTimes = settle_at_once,
) -> Supervisor:
    """The estimator of a shipped model with the same gains for every strut."""
    spec = load_model(MODELS / f"{model}.yaml")
    return supervised(
        DartPlant(spec),
        (observer,) * len(spec.struts),
        supervision,
        settling_times=settling_times,
    )


def bench_sample(struts: int, quantity: Quantity, value: float, t_ns: int) -> Sample:
    """A sample of a quantity of the bench, with the channels of `channels`."""
    return Sample(struts + MEASURED.index(quantity), value, t_ns)


def measured(
    tick: int,
    *heights_m: float | None,
    applied_n: float | None = 0.0,
    temperature_c: float | None = None,
    late_ns: int = 0,
) -> StepInput:
    """Input of a tick at 1 kHz; the applied force comes with each, as a bench sends it."""
    t_ns, struts = tick * MS, len(heights_m)
    samples = [
        Sample(strut, height_m, t_ns - late_ns)
        for strut, height_m in enumerate(heights_m)
        if height_m is not None
    ]
    for quantity, value in ((APPLIED_FORCE, applied_n), (TEMPERATURE, temperature_c)):
        if value is not None:
            samples.append(bench_sample(struts, quantity, value, t_ns))
    return StepInput(t_ns, tuple(samples))


def resting(*heights_m: float, ticks: int = FIRST, begin: int = 0) -> list[StepInput]:
    """Inputs of a bench that stands still, by default just those that start a model there."""
    return [measured(tick, *heights_m) for tick in range(begin, begin + ticks)]


def silent(begin: int, end: int) -> list[StepInput]:
    """Inputs of ticks for which no frame came."""
    return [StepInput(tick * MS) for tick in range(begin, end)]


def run(
    rig: Supervisor, inputs: list[StepInput], state: SupervisedState | None = None
) -> tuple[list[SupervisedState], list[StepOutput]]:
    """All states and outputs."""
    state = rig.init(0) if state is None else state
    states: list[SupervisedState] = []
    outputs: list[StepOutput] = []
    for step_input in inputs:
        state, output, _ = rig.step(state, step_input)
        states.append(state)
        outputs.append(output)
    return states, outputs
