"""Samples that arrive after the step that they belong to: they are used there.

The steps since the oldest sample that may still come are remembered, each with the state before it
and with its samples. A late sample is added to those of its step, and the estimator takes the steps
from there on again: its state is the one that it would have, had the frame not been late. What was
published meanwhile was a prediction.

Reference: Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation"
(2001), on out-of-sequence measurements: to process them again in order is the optimal way.
"""

from collections.abc import Iterator, Sequence
from functools import partial

from msgspec import Struct

from rig.bridge.estimator import AnyEstimator
from rig.bridge.values import StepInput
from rig.channels.channel import Channel, Role, Sample

MOST_STEPS = 500
"""Steps that are remembered: what came later than that is of no use to a bench."""


class PastStep(Struct, frozen=True, gc=False):
    """A step that may have to be taken again.

    Attributes:
        since_ns: Time of the step before it.
        t_ns: Its time.
        estimator: State of the estimator before it.
        samples: Its samples.
    """

    since_ns: int
    t_ns: int
    estimator: object
    samples: tuple[Sample, ...]


Past = tuple[PastStep, ...]
"""Steps, the oldest first."""


def arrival_ns(channels: Sequence[Channel], sample: Sample) -> int:
    """Time at which a sample was due to arrive, in ns."""
    return sample.t_ns + channels[sample.channel].delay_ns


def steps_of(
    channels: Sequence[Channel], samples: Sequence[Sample], t_ns: int, since_ns: int
) -> Iterator[StepInput]:
    """Steps up to a time, from an earlier one: as many as use each reference height by itself.

    A model that took several heights in one step would run away under a force that was constant
    over all of them.
    """
    step: list[Sample] = []
    heights: set[int] = set()
    for sample in samples:
        if sample.channel in heights:
            since_ns = max(
                [since_ns, *(arrival_ns(channels, x) for x in step if x.channel in heights)]
            )
            later = [
                x for x in step if channels[x.channel].role is Role.SENSOR and x.t_ns > since_ns
            ]
            yield StepInput(since_ns, tuple(x for x in step if x not in later))
            step, heights = later, set()
        step.append(sample)
        if channels[sample.channel].role is Role.HEIGHT:
            heights.add(sample.channel)
    yield StepInput(t_ns, tuple(step))


def use_late_samples(
    estimator: AnyEstimator, channels: Sequence[Channel], past: Past, late: Sequence[Sample]
) -> tuple[object, Past]:
    """State of an estimator that was given late samples in time, and the steps taken again.

    None of the samples is older than the first step.
    """
    due_ns = partial(arrival_ns, channels)
    first_ns = min(map(due_ns, late))
    first = next(i for i, step in enumerate(past) if step.t_ns >= first_ns)
    state, taken = past[first].estimator, list(past[:first])
    for step in past[first:]:
        more = [sample for sample in late if step.since_ns < due_ns(sample) <= step.t_ns]
        samples = tuple(sorted((*step.samples, *more), key=due_ns))
        taken.append(PastStep(step.since_ns, step.t_ns, state, samples))
        for step_input in steps_of(channels, samples, step.t_ns, step.since_ns):
            state, _ = estimator.step(state, step_input)
    return state, tuple(taken)


def remember(past: Past, step: PastStep, awaited_ns: int) -> Past:
    """Steps with a further one, as far back as samples may still come: those due from a time on."""
    first = max(0, len(past) + 1 - MOST_STEPS)
    while first < len(past) and past[first].t_ns <= awaited_ns:
        first += 1
    return (*past[first:], step)
