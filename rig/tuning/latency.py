"""Delay of the heights, from a run of the bench: the first estimate of a diagnosis.

A bench moved by a single sine does not determine a delay: whatever is periodic is a function of
height and velocity there. The interval is infinite then, as it is for a bench that a diagnosis
cannot compute.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dart_model.spec import ModelSpec
from rig.channels.measured_quantities import HEIGHT
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.delay_estimate import estimate_delays
from rig.plan.plan import Plan
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError

_BLOCKS = 8
"""Of cross-validation, of which an estimate makes no use."""

_BIAS_STD_S = 0.1e-3
"""Standard deviation of what the method errs by beyond its noise. On fourteen simulated benches
without a delay (friction, digressive dampers, a stiffer half of the stroke; 500 Hz, 20 µm) it found
0.08 ms RMS, less than 0.05 ms on eleven, and up to 0.24 ms on three with a digressive damper."""


class Latency(NamedTuple):
    """A delay, and its standard deviation: infinite where the run does not determine it.

    The delay is negative where the applied force is later than the height. The deviation is that
    of the noise and of the method's own errors.
    """

    delay_s: float
    std_s: float

    @property
    def low_s(self) -> float:
        """Lower end of the 95 % interval."""
        return self.delay_s - 1.96 * self.std_s

    @property
    def high_s(self) -> float:
        """Upper end of the 95 % interval."""
        return self.delay_s + 1.96 * self.std_s


def with_delay(plan: Plan, delay_s: float) -> Plan:
    """The plan with heights delayed by some time; they become stale later by it too."""
    config = plan.config
    heights = {
        name: entry.model_copy(update={"delay_s": delay_s})
        for name, entry in config.signals.height.items()
    }
    supervision = config.supervision.model_copy(
        update={
            "stale_after_s": config.supervision.stale_after_s + delay_s,
            "safe_after_s": config.supervision.safe_after_s + delay_s,
        }
    )
    signals = config.signals.model_copy(update={"height": heights})
    config = config.model_copy(update={"signals": signals, "supervision": supervision})
    return plan.with_config(config)


def estimate_latencies(folder: Path, model: ModelSpec, struts: Sequence[str]) -> list[Latency]:
    """The delays of the struts' heights in a run, against the first of its inputs.

    Raises:
        InputError: The run is damaged.
    """
    try:
        recording = read_recording(folder, struts)
        problem = build_without_delays(model, [recording], _BLOCKS, None)
        found = estimate_delays(problem)
    except RecordingError:
        return [Latency(0.0, math.inf)] * len(struts)
    latencies: list[Latency] = []
    for strut in struts:
        channel = f"{HEIGHT.column}:{strut}"
        delay_s, std_s = found.get(channel, (0.0, math.inf))
        known_s = recording.delays_s.get(channel, 0.0)
        latencies.append(Latency(known_s + delay_s, math.hypot(std_s, _BIAS_STD_S)))
    return latencies
