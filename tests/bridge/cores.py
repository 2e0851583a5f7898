"""Cores and inputs that the tests of this folder share."""

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.contract import Measurement, StepInput, StepOutput
from rig.bridge.free_model import RigCore, RigState
from rig.bridge.supervisor import Supervision
from rig.observers.pi import PiObserver
from rig.plan.quantities import OTHERS

MS = 1_000_000


def gains(proportional: float, integral: float, limit_n: float = 5000.0) -> PiObserver:
    """A PI observer."""
    return PiObserver(
        proportional_n_per_m=proportional, integral_n_per_m_s=integral, force_limit_n=limit_n
    )


def others(**given: float | None) -> tuple[float | None, ...]:
    """Quantities beside heights, by their keys."""
    assert set(given) <= {quantity.key for quantity in OTHERS}
    return tuple(given.get(quantity.key) for quantity in OTHERS)


GAINS = gains(1e5, 1e4)
SUPERVISION = Supervision(10 * MS, 500 * MS, safe_holds_last=False)


def core(
    model: str = "reference", observer: PiObserver = GAINS, supervision: Supervision = SUPERVISION
) -> RigCore:
    """The core of a shipped model with the same gains for every strut."""
    spec = load_model(MODELS / f"{model}.yaml")
    return RigCore(DartPlant(spec), (observer,) * len(spec.struts), supervision)


def measured(
    tick: int, *heights_m: float | None, applied_n: float | None = None, late_ns: int = 0
) -> StepInput:
    """Input of a tick at 1 kHz."""
    t_ns = tick * MS
    heights = tuple(
        None if height is None else Measurement(height, t_ns - late_ns) for height in heights_m
    )
    return StepInput(t_ns, heights, others(applied_force=applied_n))


def run(
    rig: RigCore, inputs: list[StepInput], state: RigState | None = None
) -> tuple[list[RigState], list[StepOutput]]:
    """All states and outputs."""
    state = rig.init(0) if state is None else state
    states: list[RigState] = []
    outputs: list[StepOutput] = []
    for step_input in inputs:
        state, output = rig.step(state, step_input)
        states.append(state)
        outputs.append(output)
    return states, outputs
