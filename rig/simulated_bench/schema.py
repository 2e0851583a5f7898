"""The schema of a bench's configuration: frozen, validated values.

Lengths are in m, forces in N, positive as in the rest of the project: a strut force pushes its two
bodies apart, an applied force points upwards, a height is the length of a strut.
"""

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    model_validator,
)

from can_dbc.errors import InputError, expected_name
from rig.simulated_bench.effects import EFFECT_KINDS, parameter_error
from rig.simulated_bench.samples import Samples, read_samples

WORLD = "world"
"""Name of the ground."""


class BenchConfigError(InputError):
    """A bench configuration that cannot be used; one line: file, key, value, expectation."""


class _Section(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)


Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}$")]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Nanoseconds = Annotated[int, Field(ge=0, le=10**10)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Points = Annotated[tuple[float, ...], Field(strict=False, min_length=2, max_length=1000)]


class Mass(_Section):
    """A body that moves along the vertical axis, or a rigid body that heaves, pitches and rolls.

    Attributes:
        name: Name of the body.
        mass_kg: Mass of the body in kg.
        moments_kg_m2: Moments of inertia of a rigid body about its axes x (roll), y (pitch) and z,
            in kg·m²; absent for a body that only moves vertically.
    """

    name: Name
    mass_kg: Positive
    moments_kg_m2: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] | None = None


class _Curve(_Section):
    """A force by points: two fields, the abscissa and the force."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        (key, at), (_, force_n) = self
        if len(at) != len(force_n):
            raise ValueError(f"force_n has {len(force_n)} points, expected {len(at)} as {key}")
        for before, after in pairwise(at):
            if after <= before:
                raise ValueError(
                    f"{key} has {after:g} after {before:g}, expected increasing values"
                )
        return self


class SpringCurve(_Curve):
    """Spring force over height, by points; monotone cubic between, linear beyond.

    Attributes:
        height_m: Heights, increasing, in m.
        force_n: Force at each height in N, positive when the spring pushes its bodies apart.
    """

    height_m: Points
    force_n: Points


class DamperCurve(_Curve):
    """Damper force over velocity, by points; monotone cubic between, linear beyond.

    Attributes:
        velocity_m_per_s: Time derivatives of the height (rebound is positive), increasing, in m/s.
        force_n: Force at each velocity in N, positive when the damper pushes its bodies apart.
    """

    velocity_m_per_s: Points
    force_n: Points


class BenchStrut(_Section):
    """A spring and a damper between two bodies, or between the world and a body.

    Attributes:
        name: Name of the strut.
        between: Lower and upper body. The lower one is `world` or the upper body of a strut earlier
            in the list. Every body is the upper body of exactly one strut, a rigid body of three
            or more.
        place_m: Where the strut is on a rigid body, along its axes x and y from the centre of mass,
            in m. Struts are vertical: their height is that of the upper end above the lower one.
        free_length_m: Height at which the deflection is zero in the laws of undeclared effects, in
            m.
        spring: Spring curve, given by points: monotone cubic interpolation between them, linear
            extrapolation beyond them.
        damper: Damper curve, given by points: monotone cubic interpolation between them, linear
            extrapolation beyond them.
        initial_height_m: Height at the start in m; the static equilibrium if absent.
    """

    name: Name
    between: Annotated[tuple[Name, Name], Field(strict=False)]
    place_m: Annotated[tuple[float, float], Field(strict=False)] | None = None
    free_length_m: Positive
    spring: SpringCurve
    damper: DamperCurve
    initial_height_m: Positive | None = None


class _Sine(_Section):
    """A sine: amplitude * sin(angular frequency * t + phase_rad).

    Attributes:
        kind: `sine`: amplitude * sin(angular frequency * t + phase).
        frequency_hz: Frequency in Hz; either this or `angular_frequency_rad_per_s` is required.
        angular_frequency_rad_per_s: Angular frequency in rad/s, instead of `frequency_hz`.
        phase_rad: Phase at time zero in rad.
    """

    kind: Literal["sine"]
    frequency_hz: Positive | None = None
    angular_frequency_rad_per_s: Positive | None = None
    phase_rad: float = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.frequency_hz is None) == (self.angular_frequency_rad_per_s is None):
            raise ValueError("expected one of frequency_hz and angular_frequency_rad_per_s")
        return self

    @property
    def rate_rad_per_s(self) -> float:
        """Angular frequency in rad/s, whichever way it was given."""
        if self.angular_frequency_rad_per_s is not None:
            return self.angular_frequency_rad_per_s
        return 2.0 * math.pi * (self.frequency_hz or 0.0)


class Sine(_Sine):
    """A sine force.

    Attributes:
        amplitude_n: Amplitude in N.
    """

    amplitude_n: float


class HeightSine(_Sine):
    """A sine motion.

    Attributes:
        amplitude_m: Amplitude in m.
    """

    amplitude_m: float


class _Multisine(_Section):
    """Sines of equal amplitude and random phase at equally spaced frequencies of a band.

    Attributes:
        kind: `multisine`: sines of equal amplitude and random phase at equally spaced frequencies.
        low_hz: Lowest frequency in Hz.
        high_hz: Highest frequency in Hz.
        lines: Number of frequencies.
        seed: Seed of the random phases.
    """

    kind: Literal["multisine"]
    low_hz: Positive
    high_hz: Positive
    lines: Annotated[int, Field(ge=2, le=400)] = 40
    seed: Seed

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.high_hz <= self.low_hz:
            raise ValueError(f"high_hz = {self.high_hz:g}, expected more than low_hz")
        return self


class Multisine(_Multisine):
    """A multisine force; `rms_n` is the root mean square of the sum.

    Attributes:
        rms_n: Root mean square of the sum in N.
    """

    rms_n: Positive


class HeightMultisine(_Multisine):
    """A multisine motion; `rms_m` is the root mean square of the sum.

    Attributes:
        rms_m: Root mean square of the sum in m.
    """

    rms_m: Positive


class _Sweep(_Section):
    """A sine whose frequency runs from one value to another within `duration_s`.

    Attributes:
        kind: `sweep`: a sine whose frequency changes.
        start_hz: Frequency at the start in Hz.
        end_hz: Frequency at the end in Hz.
        duration_s: Time from start to end in s.
        spacing: Change of the frequency over time: `linear` or `logarithmic`.
    """

    kind: Literal["sweep"]
    start_hz: Positive
    end_hz: Positive
    duration_s: Positive
    spacing: Literal["linear", "logarithmic"] = "linear"


class Sweep(_Sweep):
    """A swept force; zero after `duration_s`.

    Attributes:
        kind: `sweep`: a sine whose frequency changes; zero after `duration_s`.
        amplitude_n: Amplitude in N.
    """

    amplitude_n: float


class HeightSweep(_Sweep):
    """A swept motion; it stays where it ends.

    Attributes:
        kind: `sweep`: a sine whose frequency changes; constant after `duration_s`.
        amplitude_m: Amplitude in m.
    """

    amplitude_m: float


class _File(_Section):
    """A column of a CSV file over its column `t_s`.

    Attributes:
        kind: `file`: a column of a CSV file.
        path: CSV file in the configuration's folder.
    """

    column: ClassVar[str]
    kind: Literal["file"]
    path: Annotated[str, Field(min_length=1, max_length=1000)]
    _samples: Samples = PrivateAttr()

    @property
    def samples(self) -> Samples:
        """The samples of the file, read once when the configuration is validated."""
        return self._samples

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> Self:
        folder = info.context if isinstance(info.context, Path) else Path()
        self._samples = read_samples(folder, self.path, self.column)
        return self


class ForceFile(_File):
    """A force from column `applied_force_n`, straight between samples, zero outside them.

    Attributes:
        kind: `file`: a column of a CSV file, linear between samples, zero outside them.
        path: CSV file in the configuration's folder, with the columns `t_s` and `applied_force_n`.
    """

    column = "applied_force_n"


class HeightFile(_File):
    """A motion from column `height_m`, a cubic spline between samples, still outside them.

    Attributes:
        kind: `file`: a column of a CSV file, a cubic spline between samples, constant outside them.
        path: CSV file in the configuration's folder, with the columns `t_s` and `height_m`.
    """

    column = "height_m"


Component = Annotated[Sine | Multisine | Sweep | ForceFile, Field(discriminator="kind")]


class AppliedForce(_Section):
    """The force that drives the bench.

    Attributes:
        body: Body on which the force acts; absent if no force is applied.
        components: Forces that add up.
    """

    body: Name | None = None
    components: Annotated[tuple[Component, ...], Field(strict=False, max_length=50)] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.components and self.body is None:
            raise ValueError("body is missing, expected the body on which the components act")
        return self


HeightComponent = Annotated[
    HeightSine | HeightMultisine | HeightSweep | HeightFile, Field(discriminator="kind")
]


class StrutMotion(_Section):
    """A motion that a strut is forced through, whatever force it takes: a damper dyno.

    Attributes:
        strut: Strut whose height is prescribed.
        mean_height_m: Constant part of the height, to which the components are added, in m.
        components: Motions that add up.
    """

    strut: Name
    mean_height_m: float = 0.0
    components: Annotated[tuple[HeightComponent, ...], Field(strict=False, max_length=50)]


class Temperature(_Section):
    """The damper's temperature: heated by what the damper curves dissipate, cooled by the air.

    Attributes:
        initial_c: Temperature at the start in degrees Celsius.
        ambient_c: Temperature of the air in degrees Celsius.
        heat_capacity_j_per_k: Heat capacity of all dampers together in J/K; if absent, the
            dissipated power does not heat them.
        cooling_time_s: Time constant of cooling in s; if absent, the air does not cool the dampers.
    """

    initial_c: float = 20.0
    ambient_c: float = 20.0
    heat_capacity_j_per_k: Positive | None = None
    cooling_time_s: Positive | None = None


class UndeclaredEffect(_Section):
    """An effect of the bench that no model declares.

    Attributes:
        name: Name of the effect, as in the table of effects.
        strut: Strut in which the effect acts, or whose upper body it changes; `input_gain` and
            `delay` change the applied force, whatever the strut is.
        parameters: Values of the effect's parameters, by name; those with a default may be absent.
    """

    name: str
    strut: Name
    parameters: dict[str, float] = {}

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.name not in EFFECT_KINDS:
            raise ValueError(f"name = {self.name!r}, {expected_name(self.name, EFFECT_KINDS)}")
        wrong = parameter_error(self.name, self.parameters)
        if wrong is not None:
            raise ValueError(f"parameters: {wrong}")
        return self


class _Sensor(_Section):
    """A sensor; its last field is the standard deviation of its white noise.

    Attributes:
        signal: Signal of the message.
    """

    signal: str

    @property
    def offset(self) -> float:
        """What the sensor reads at zero, in its unit; 0 of one without such a key."""
        return next((value for key, value in self if key.startswith("offset_")), 0.0)

    @property
    def noise_std(self) -> float:
        """Standard deviation of the noise in the sensor's unit."""
        *_, (_, value) = self
        return value


class HeightSensor(_Sensor):
    """A sensor of a strut's height; `noise_std_m` is the standard deviation of white noise.

    Attributes:
        strut: Strut whose height it measures.
        offset_m: Reading at a height of zero, in m, such as that of a draw-wire sensor with an
            arbitrary zero.
        noise_std_m: Standard deviation of white noise in m.
    """

    strut: Name
    offset_m: float = 0.0
    noise_std_m: NotNegative = 0.0


class AppliedForceSensor(_Sensor):
    """A sensor of the applied force; `noise_std_n` is the standard deviation of white noise.

    Attributes:
        offset_n: Reading without a force, in N.
        noise_std_n: Standard deviation of white noise in N.
    """

    offset_n: float = 0.0
    noise_std_n: NotNegative = 0.0


class LoadCell(_Sensor):
    """A sensor of a strut's force; `noise_std_n` is the standard deviation of white noise.

    Attributes:
        strut: Strut whose force it measures.
        offset_n: Reading without a force, in N.
        noise_std_n: Standard deviation of white noise in N.
    """

    strut: Name
    offset_n: float = 0.0
    noise_std_n: NotNegative = 0.0


class Thermometer(_Sensor):
    """A sensor of the damper's temperature; `noise_std_k` is that of white noise.

    Attributes:
        noise_std_k: Standard deviation of white noise in K.
    """

    noise_std_k: NotNegative = 0.0


class Transmission(_Section):
    """One message of the bench: its sensors, delay and loss.

    Attributes:
        message: Message of the DBC.
        period_ns: Time between samples in ns; the cycle time in the DBC if absent.
        latency_ns: Time from sample to transmission in ns.
        jitter_ns: Largest additional delay in ns; the additional delay is uniformly distributed
            from zero to this value.
        loss_probability: Probability that a frame is lost; the message's counter, if it has one,
            shows the loss.
        height: Height sensor whose reading is in the message, if any.
        applied_force: Sensor of the applied force whose reading is in the message, if any.
        strut_force: Load cell whose reading is in the message, if any.
        temperature: Thermometer whose reading is in the message, if any.
        counter: Signal that counts the frames, for a message without E2E protection.
        time: Signal with the sample time by the clock of the bench; it wraps around at the end of
            its range.
    """

    message: str
    period_ns: Annotated[int, Field(ge=1_000, le=10**10)] | None = None
    latency_ns: Nanoseconds = 0
    jitter_ns: Nanoseconds = 0
    loss_probability: Probability = 0.0
    height: HeightSensor | None = None
    applied_force: AppliedForceSensor | None = None
    strut_force: LoadCell | None = None
    temperature: Thermometer | None = None
    counter: str | None = None
    time: str | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not (self.height or self.applied_force or self.strut_force or self.temperature):
            raise ValueError(
                "expected one or more of height, applied_force, strut_force, temperature"
            )
        return self


def _as_list(given: object) -> object:
    """A single item as a list of one, none as an empty one."""
    if given is None:
        return ()
    return cast("object", given) if isinstance(given, list | tuple) else (given,)


class BenchConfig(_Section):
    """A simulated bench, complete.

    Attributes:
        name: Name of the bench.
        gravity_m_per_s2: Gravitational acceleration.
        masses: Bodies.
        struts: Struts. Each carries one body; its lower end is the world or another body.
        applied_force: The force that drives the bench, if any; positive upwards.
        prescribed_motion: The motion that drives a strut, if any (a dyno, a road), or a list of
            such motions.
        temperature: Temperature, common to all dampers: the power that their damper curves
            dissipate heats them, and the air cools them.
        undeclared_effects: Effects of the bench that the bridge's model does not contain.
        transmissions: Messages that the bench sends; `rig bench` requires at least one.
        seed: Seed of the random numbers for noise, jitter and loss.
        step_ns: Longest step of the integrator in ns.
    """

    name: Name
    gravity_m_per_s2: NotNegative = 9.81
    masses: Annotated[tuple[Mass, ...], Field(strict=False, min_length=1, max_length=20)]
    struts: Annotated[tuple[BenchStrut, ...], Field(strict=False, min_length=1, max_length=20)]
    applied_force: AppliedForce = AppliedForce()
    prescribed_motion: Annotated[
        tuple[StrutMotion, ...], Field(strict=False, max_length=20), BeforeValidator(_as_list)
    ] = ()
    temperature: Temperature = Temperature()
    undeclared_effects: Annotated[
        tuple[UndeclaredEffect, ...], Field(strict=False, max_length=50)
    ] = ()
    transmissions: Annotated[tuple[Transmission, ...], Field(strict=False, max_length=50)] = ()
    seed: Seed = 0
    step_ns: Annotated[int, Field(ge=1_000, le=10_000_000)] = 100_000

    @model_validator(mode="after")
    def _check(self) -> Self:
        masses = _unique("masses", [mass.name for mass in self.masses])
        struts = _unique("struts", [strut.name for strut in self.struts])
        _check_tree(self.struts, self.masses)
        if self.applied_force.body is not None:
            _check_known("applied_force.body", self.applied_force.body, masses)
        for motion in self.prescribed_motion:
            _check_known("prescribed_motion.strut", motion.strut, struts)
            _check_strut_motion(motion.strut, self.struts, self.undeclared_effects)
        _unique("prescribed_motion", [motion.strut for motion in self.prescribed_motion])
        for index, effect in enumerate(self.undeclared_effects):
            _check_known(f"undeclared_effects.{index}.strut", effect.strut, struts)
        for index, sent in enumerate(self.transmissions):
            for key, sensor in (("height", sent.height), ("strut_force", sent.strut_force)):
                if sensor is not None:
                    _check_known(f"transmissions.{index}.{key}.strut", sensor.strut, struts)
        return self


def _unique(key: str, names: list[str]) -> list[str]:
    for name in names:
        if name == WORLD or names.count(name) > 1:
            raise ValueError(f"{key}: name {name} is taken, expected another")
    return names


def _check_known(key: str, name: str, known: list[str]) -> None:
    if name not in known:
        raise ValueError(f"{key} = {name!r}, {expected_name(name, known)}")


_UNSEEN_IN_PRESCRIBED_MOTION = ("added_mass", "hidden_mass")


def _check_strut_motion(
    name: str, struts: tuple[BenchStrut, ...], effects: tuple[UndeclaredEffect, ...]
) -> None:
    strut = next(strut for strut in struts if strut.name == name)
    if strut.place_m is not None:
        raise ValueError(f"prescribed_motion: {name} carries a rigid body, expected another strut")
    if strut.initial_height_m is not None:
        raise ValueError(
            f"struts: {name} has an initial_height_m, expected none: its motion is prescribed"
        )
    for index, effect in enumerate(effects):
        if effect.strut == name and effect.name in _UNSEEN_IN_PRESCRIBED_MOTION:
            raise ValueError(
                f"undeclared_effects.{index}: {effect.name} does not change the force of strut "
                f"{name}, whose motion is prescribed, expected another effect"
            )


def _check_tree(struts: tuple[BenchStrut, ...], masses: tuple[Mass, ...]) -> None:
    rigid = {mass.name for mass in masses if mass.moments_kg_m2 is not None}
    names = [mass.name for mass in masses]
    carried: list[str] = []
    for index, strut in enumerate(struts):
        lower, upper = strut.between
        free = [name for name in names if name not in carried or name in rigid]
        _check_known(f"struts.{index}.between.0", lower, [WORLD, *carried])
        _check_known(f"struts.{index}.between.1", upper, free)
        _check_place(f"struts.{index}", strut, rigid)
        carried.append(upper)
    for name in names:
        least = 3 if name in rigid else 1
        if carried.count(name) < least:
            expected = f"{least} that carry" if least > 1 else "one that carries"
            raise ValueError(f"struts: expected {expected} {name}")


def _check_place(key: str, strut: BenchStrut, rigid: set[str]) -> None:
    on_rigid = [name for name in strut.between if name in rigid]
    if len(on_rigid) > 1:
        raise ValueError(f"{key}.between: expected a rigid body at one end alone")
    if bool(on_rigid) != (strut.place_m is not None):
        expected = "one, the place on the rigid body" if on_rigid else "none without a rigid body"
        raise ValueError(f"{key}.place_m: expected {expected}")
    if strut.between[1] in rigid and strut.initial_height_m is not None:
        raise ValueError(f"{key}.initial_height_m: expected none of a strut below a rigid body")
