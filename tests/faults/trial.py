"""The reference case with a fault between bench and bridge, tick by tick and without a clock."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from can_dbc.codec import compile_encoder
from can_dbc.frame import Frame
from can_dbc.protection import compile_protector
from can_dbc.units import Dimension
from rig.bridge.bridge import Bridge, BridgeState, TickResult
from rig.bridge.counts import Conditions, Counts
from rig.bridge.values import Mode, StepInput
from rig.channels.channel import Sample
from rig.observers.protocol import AnyObserver
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate

MS = 1_000_000
BEGIN_MS = 2000
BEGIN_NS = BEGIN_MS * MS
"""When a fault begins: the estimate has settled by then, and is valid."""

SETTLING_MS = 1882
"""What the shipped configuration's loop takes to settle, by `test_settling`."""

MEASUREMENT = 0x100


def height_of(result: TickResult) -> Sample | None:
    """The height that the last step of a tick was given; None where none came."""
    heights = [item for item in result.step_input.samples if item.channel == 0]
    return heights[-1] if heights else None


Inject = Callable[[int, list[Frame]], list[Frame]]
"""Time of a tick and the bench's frames up to it -> the frames that arrive."""


class Tick(NamedTuple):
    """What a tick did.

    Attributes:
        t_ns: Its time.
        result: What the bridge did.
        counts: What it has counted.
        truth_n: Force of the strut at that time.
    """

    t_ns: int
    result: TickResult
    counts: Counts
    truth_n: float

    @property
    def mode(self) -> Mode:
        return self.result.output.mode

    @property
    def force_n(self) -> float:
        return self.result.output.struts[0].force_n

    @property
    def is_valid(self) -> bool:
        return bool(self.result.output.struts and self.result.output.struts[0].valid)


class Trial:
    """A bridge and a bench, joined tick by tick."""

    def __init__(
        self, devices: object = None, observer: AnyObserver | None = None, **supervision: object
    ) -> None:
        ready = load_plan(CONFIGS / "reference.yaml")
        if observer is not None:
            observers = {"observers": {ready.model.struts[0].name: observer}}
            ready = ready.with_config(ready.config.model_copy(update=observers))
        content = ready.config.model_dump(mode="json")
        content["supervision"] |= supervision
        if observer is not None and observer.knows_std:
            std = {"message": "RIG_UNCERTAINTY", "signal": "FORCE_STD"}
            for published in content["publish"].values():
                published["force_std"] = std
        config = ready.config.model_validate(content | {"devices": devices or {}})
        self.ready = ready.with_config(config)
        self.bridge: Bridge = build_bridge(self.ready)
        self.bench = SimulatedBench(
            load_bench_config(CONFIGS / "reference_bench.yaml"), ready.database
        )
        self.state: BridgeState = self.bridge.init(0)
        self.ticks: list[Tick] = []

    def value(self, step_input: StepInput, name: str) -> float | None:
        """Last value of a channel in the input of a step; None where none came."""
        index = next(channel.index for channel in self.ready.channels if channel.name == name)
        values = [item.value for item in step_input.samples if item.channel == index]
        return values[-1] if values else None

    def run(
        self,
        until_ms: int,
        inject: Inject = lambda _t_ns, frames: frames,
        conditions: Callable[[int], Conditions] = lambda _t_ns: Conditions(),
    ) -> list[Tick]:
        """Run up to a time; returns all ticks so far."""
        first = len(self.ticks)
        truth = simulate(self.bench.config, until_ms * MS, MS)
        for index in range(first, until_ms):
            t_ns = index * MS
            frames = inject(t_ns, self.bench.update(t_ns)[0])
            self.state, result = self.bridge.tick(self.state, t_ns, frames, conditions(t_ns))
            truth_n = float(truth.strut_force_n[index, 0])
            self.ticks.append(Tick(t_ns, result, self.state.counts, truth_n))
        return self.ticks


def after(begin_ns: int, fault: Inject) -> Inject:
    """A fault that begins at a time."""
    return lambda t_ns, frames: fault(t_ns, frames) if t_ns >= begin_ns else frames


def measurements_only(change: Callable[[Frame], list[Frame]]) -> Inject:
    """A fault of single frames, of the measurement alone."""

    def inject(_t_ns: int, frames: list[Frame]) -> list[Frame]:
        arriving: list[Frame] = []
        for frame in frames:
            arriving += change(frame) if frame.arbitration_id == MEASUREMENT else [frame]
        return arriving

    return inject


class Gateway:
    """Holds all frames back for some ticks, every so often; they are stamped when they come out."""

    def __init__(self, held: int, every: int) -> None:
        self._held, self._every = held, every
        self._kept: list[Frame] = []
        self.is_holding = False

    def __call__(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        self._kept += frames
        self.is_holding = (t_ns // MS) % self._every < self._held
        if self.is_holding:
            return []
        kept, self._kept = self._kept, []
        return [replace(frame, t_ns=t_ns) for frame in kept]


def first_ms(ticks: list[Tick], when: Callable[[Tick], bool], begin_ns: int = BEGIN_NS) -> float:
    """Time from the beginning of the fault to the first tick that shows something, in ms."""
    found = next((tick.t_ns for tick in ticks if tick.t_ns >= begin_ns and when(tick)), None)
    assert found is not None, "the fault was not noticed"
    return (found - begin_ns) / MS


def force_error_n(ticks: list[Tick], begin_ns: int = BEGIN_NS) -> float:
    """RMS error of the force where it was published as valid."""
    errors = [
        tick.force_n - tick.truth_n for tick in ticks if tick.t_ns >= begin_ns and tick.is_valid
    ]
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


SWITCHES = 0x200
SWITCH_CYCLE_MS = 10


def trial_with_auxiliary(*names: str, **supervision: object) -> Trial:
    """A trial whose bridge reads some quantities of the auxiliary message, by their keys."""
    trial = Trial(**supervision)
    content = trial.ready.config.model_dump(mode="json")
    for name in names:
        content["signals"][name] = {"message": "BENCH_AUXILIARY", "signal": name.upper()}
    trial.ready = trial.ready.with_config(trial.ready.config.model_validate(content))
    trial.bridge = build_bridge(trial.ready)
    trial.state = trial.bridge.init(0)
    return trial


class Switches:
    """Frames of the switches, or of other signals of their message, every 10 ms.

    They take the place of the bench's own ones.
    """

    def __init__(self, trial, dimension=Dimension.NUMBER, **closed):
        message = trial.ready.database.message("BENCH_AUXILIARY")
        self._names = [name.upper() for name in closed]
        self._encode = compile_encoder(message, self._names, [dimension] * len(closed))
        self._protect = compile_protector(message.protection)
        self._counter = 0
        self.closed = closed
        self.is_silent = False

    def __call__(self, t_ns, frames):
        kept = [frame for frame in frames if frame.arbitration_id != SWITCHES]
        if self.is_silent or t_ns // MS % SWITCH_CYCLE_MS:
            return kept
        data = self._encode([float(value) for value in self.closed.values()])[0]
        data = self._protect(data, self._counter)
        self._counter += 1
        return [*kept, frames[0].__class__(t_ns, SWITCHES, data)]
