"""The bridge that a plan describes, and the model in it."""

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import cast

from can_dbc.database import Message
from can_dbc.errors import InputError, expected_name
from dart_model.plant import DartPlant, PrescribedStrut
from dart_model.protocol import AnyPlant, AnySensorReader
from dart_model.spec import ModelSpec
from rig.bridge.bridge import Bridge
from rig.bridge.estimator import AnyEstimator
from rig.bridge.free_model import FreeModelEstimator, SettlingTimes
from rig.bridge.incoming_messages import Alarm, Incoming, compile_incoming
from rig.bridge.measured_inputs import AnyInput, HeldInput, MovedInput
from rig.bridge.mode_supervisor import Supervisor
from rig.bridge.motion_errors import MotionErrorTracker, block_for
from rig.bridge.outgoing_messages import compile_outgoing
from rig.bridge.prescribed_motion import PrescribedMotionEstimator
from rig.bridge.virtual_sensors import SensorPlace, VirtualSensors, is_of_motion
from rig.channels.channel import Channel
from rig.channels.measured_quantities import LOAD_CELL_FORCE
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.noise_response import motion_by_noise
from rig.closed_loop.settling import settling_times_ns
from rig.closed_loop.strut_response import linearise_at
from rig.observers.protocol import AnyObserver, AnyTunableObserver
from rig.plan.plan import Plan, PlannedInput
from rig.plan.virtual_sensors import make_reader

ENGINES: Mapping[str, Callable[[ModelSpec], AnyPlant]] = MappingProxyType({"dart": DartPlant})
"""`engine` in a configuration -> what makes a plant of a model. A further one is a line here."""


def build_bridge(plan: Plan, *, sending: bool = True) -> Bridge:
    """Build the bridge of a plan; without `sending` it makes no frames, and computes the same.

    Raises:
        InputError: The model cannot be built.
        DatabaseError: A signal does not fit its quantity.
    """
    outgoing, estimator = plan.outgoing if sending else (), _build_estimator(plan)
    return Bridge(
        Supervisor(
            estimator,
            plan.config.supervision,
            plan.limits.struts,
            plan.bench_channel(LOAD_CELL_FORCE),
        ),
        plan.channels,
        _compile_incoming(plan),
        [compile_outgoing(item.message, item.signals) for item in outgoing],
        plan.devices,
        plan.limits,
        _virtual_sensors(plan, estimator),
    )


def _virtual_sensors(plan: Plan, estimator: AnyEstimator) -> VirtualSensors | None:
    sensors = plan.virtual_sensors
    if not sensors:
        return None
    of_model = {item.name: item.sensor for item in sensors if item.strut < 0}
    reader = make_reader(estimator.read_model, of_model, plan.source) if of_model else None
    places = [item.place for item in sensors]
    tracker = None if reader is None else _motion_errors(plan, places, reader)
    return VirtualSensors(places, reader, tracker)


def _motion_errors(
    plan: Plan, places: Sequence[SensorPlace], reader: AnySensorReader
) -> MotionErrorTracker | None:
    """What tracks the errors of sensors of motions; None where nothing shows them."""
    of_model = [item for item in places if item.strut < 0]
    sensors = [index for index, item in enumerate(of_model) if is_of_motion(item)]
    struts = [strut for strut, item in enumerate(plan.observers) if item.requires_height]
    motions = [item.channel for item in plan.inputs if item.is_motion and item.channel is not None]
    if not sensors or not (struts or motions):
        return None
    plant, rest_m = build_plant(plan), [strut.free_length_m for strut in plan.struts]
    responses = linearise_at(plant, rest_m).responses()
    corners_per_s = [
        2.0 * math.pi * cast("AnyTunableObserver", observer).bandwidth_hz(response.mobility_per_kg)
        for observer, response in zip(plan.observers, responses, strict=True)
        if observer.estimates_force
    ]
    intervals_ns = [plan.struts[strut].interval_ns for strut in struts]
    intervals_ns += [channel.interval_ns for channel in motions]
    return MotionErrorTracker(
        reader,
        sensors,
        struts,
        [*struts, *range(len(plan.struts), len(plan.struts) + len(motions))],
        [of_model[index].known_by == "rate" for index in sensors],
        block_for(corners_per_s, intervals_ns),
        motion_by_noise(plant, plan.observers, rest_m, sample_timing(plan), struts),
    )


def build_plant(plan: Plan) -> AnyPlant:
    """Build the model of a plan in the configuration's engine.

    Raises:
        InputError: There is no such engine, or the model cannot be built.
    """
    engine = plan.config.engine
    make = ENGINES.get(engine)
    if make is None:
        raise InputError(f"{plan.source}: engine {engine!r}: {expected_name(engine, ENGINES)}")
    return make(plan.model)


def _build_estimator(plan: Plan) -> AnyEstimator:
    stale_after_ns = plan.config.supervision.stale_after_ns
    motion = plan.config.prescribed_motion
    if motion is not None:
        model = PrescribedStrut(plan.model)
        return PrescribedMotionEstimator(model, motion.settling_s, plan.channels, stale_after_ns)
    plant = build_plant(plan)
    return FreeModelEstimator(
        plant,
        plan.observers,
        plan.channels,
        [_measured_input(item) for item in plan.inputs],
        stale_after_ns,
        settling_times(plan),
        plan.config.supervision.settling_s,
    )


def _measured_input(item: PlannedInput) -> AnyInput:
    if item.is_motion and item.channel is not None:
        return MovedInput(item.channel, item.acceleration, item.settling_s)
    return HeldInput(item.channel)


def sample_timing(plan: Plan) -> SampleTiming:
    """Timing of the closed loop: that of the strut that is measured least often, and latest."""
    return SampleTiming.of(
        plan.period_ns,
        max(strut.interval_ns for strut in plan.struts),
        max(strut.delay_ns for strut in plan.struts),
    )


def settling_times(plan: Plan) -> SettlingTimes:
    """Settling times with some observers: those of the closed loop at rest."""
    rest_m = [strut.free_length_m for strut in plan.struts]
    # The laws are steeper at rest than in motion, friction above all: without them the model is
    # damped as little as it ever is. Both are models of their own, since this one may be running.
    bare = [strut.model_copy(update={"effects": ()}) for strut in plan.model.struts]
    plans = (plan, plan.with_model(plan.model.model_copy(update={"struts": tuple(bare)})))
    timing = sample_timing(plan)

    def longest_times_ns(observers: Sequence[AnyObserver]) -> list[int | None]:
        models = [build_plant(item) for item in plans]
        every = [settling_times_ns(model, observers, rest_m, timing) for model in models]
        return [
            max((time_ns for time_ns in times if time_ns is not None), default=None)
            for times in zip(*every, strict=True)
        ]

    return longest_times_ns


def _compile_incoming(plan: Plan) -> list[Incoming]:
    """The messages of the bench, in the order in which the channels name them."""
    messages: dict[str, Message] = {}
    channels: dict[str, list[Channel]] = {}
    alarms: dict[str, list[Alarm]] = {}
    for channel in plan.channels:
        if channel.message is not None:
            messages[channel.message.name] = channel.message
            channels.setdefault(channel.message.name, []).append(channel)
    for message, alarm in plan.alarms:
        messages[message.name] = message
        alarms.setdefault(message.name, []).append(alarm)
    devices = {device.name: index for index, device in enumerate(plan.devices)}
    return [
        compile_incoming(
            message,
            channels.get(name, ()),
            alarms.get(name, ()),
            devices.get(message.sender or ""),
        )
        for name, message in messages.items()
    ]
