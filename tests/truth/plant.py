"""What a simulated bench consists of: body, spring and damper, planted effects, sensors, runs."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float64]


@dataclass(frozen=True)
class Bench:
    """One body on a spring and a damper; what the model file says, but for its roughness.

    m z'' = -K (z - free_length) - C z' + effects + load - m g
    """

    mass_kg: float
    stiffness_n_per_m: float
    damping_n_s_per_m: float
    free_length_m: float
    gravity_m_per_s2: float = 9.81

    @property
    def weight_n(self) -> float:
        return self.mass_kg * self.gravity_m_per_s2

    @property
    def natural_hz(self) -> float:
        return float(np.sqrt(self.stiffness_n_per_m / self.mass_kg) / (2 * np.pi))

    @property
    def damping_ratio(self) -> float:
        return self.damping_n_s_per_m / (2 * float(np.sqrt(self.stiffness_n_per_m * self.mass_kg)))


@dataclass(frozen=True)
class Planted:
    """One effect that the model lacks.

    Attributes:
        family: Family as in a diagnosis, or ``outside`` for what no catalogue has.
        law: Name of the formula, see `tests.truth.compiled`.
        truth: Its parameters in SI, the unit in each name.
    """

    family: str
    law: str
    truth: dict[str, float] = field(hash=False)


@dataclass(frozen=True)
class Excitation:
    """A load as a function of continuous time.

    Attributes:
        shape: ``multisine``, ``sweep`` or ``noise``.
        amplitude_n: RMS (about) of the dynamic part.
        bias_n: Mean load.
        low_hz: Lower end of the band.
        high_hz: Upper end of the band.
        tilt: Exponent of the dynamic stiffness by which the amplitude is shaped, so that a
            resonance does not swallow the whole stroke.
        duration_s: Length of the run.
        seed: Of phases and lines.
    """

    shape: str
    amplitude_n: float
    bias_n: float
    low_hz: float
    high_hz: float
    tilt: float
    duration_s: float
    seed: int


@dataclass(frozen=True)
class Stroke:
    """A height that a dyno prescribes: a sum of sines, as a function of continuous time.

    Attributes:
        stroke_m: Highest less lowest height of the run.
        middle_m: Height about which the sines swing.
        low_hz: Lower end of the band.
        high_hz: Upper end of the band.
        tilt: Amplitudes fall with the frequency to this power.
        duration_s: Length of the run.
        seed: Of phases and lines.
    """

    stroke_m: float
    middle_m: float
    low_hz: float
    high_hz: float
    tilt: float
    duration_s: float
    seed: int


@dataclass(frozen=True)
class Roughness:
    """How far the model file is from the bench in what is linear; by default not at all.

    Attributes:
        mass: The file's mass over the bench's, less one.
        stiffness: Likewise.
        damping: Likewise.
        preload_n: Force that the file's spring lacks at the bench's free length: the file's free
            length is wrong.
        input_gain: The load over what the sensor says of it, less one; no file holds it.
    """

    mass: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    preload_n: float = 0.0
    input_gain: float = 0.0

    @property
    def is_exact(self) -> bool:
        return self == Roughness()

    def applied(self, bench: Bench) -> Bench:
        """The bench as the model file describes it."""
        stiffness = bench.stiffness_n_per_m * (1.0 + self.stiffness)
        return replace(
            bench,
            mass_kg=bench.mass_kg * (1.0 + self.mass),
            stiffness_n_per_m=stiffness,
            damping_n_s_per_m=bench.damping_n_s_per_m * (1.0 + self.damping),
            free_length_m=bench.free_length_m - self.preload_n / stiffness,
        )


@dataclass(frozen=True)
class Sensors:
    """What the bench's electronics make of the truth; a load cell is a dyno's.

    Attributes:
        noise_time_s: Time constant of the noise of height and load cell; 0: white.
        late_s: By how much the height is late.
    """

    sample_rate_hz: int
    height_noise_m: float
    force_noise_n: float = 0.0
    height_step_m: float = 2e-6
    load_step_n: float = 0.01
    temperature_noise_k: float = 0.05
    has_temperature: bool = False
    noise_time_s: float = 0.0
    late_s: float = 0.0

    @property
    def height_error_m(self) -> float:
        """RMS of noise and quantisation together."""
        return float(np.hypot(self.height_noise_m, self.height_step_m / np.sqrt(12)))

    @property
    def force_error_n(self) -> float:
        """RMS of the load cell's noise and quantisation together."""
        return float(np.hypot(self.force_noise_n, self.load_step_n / np.sqrt(12)))


@dataclass(frozen=True)
class RunPlan:
    """One run: what is commanded, and on a bench with a free body how that is let go."""

    excitation: Excitation | Stroke
    start_offset_m: float
    ambient_c: float
    noise_seed: int


@dataclass(frozen=True)
class Case:
    """A bench, what is planted in it, and its two runs.

    Attributes:
        name: Unique in a benchmark.
        kind: As given to `make_case`.
        families: Families of the planted effects, in the order of `effects`.
        effects: The truth.
        bench: The true one; the model file describes it as the roughness has it.
        sensors: Noise, resolution, rate.
        train: The run that is diagnosed.
        held_out: Another run of the same bench.
        seed: From which all of it follows.
        roughness: Of the model file.
    """

    name: str
    kind: str
    families: tuple[str, ...]
    effects: tuple[Planted, ...]
    bench: Bench
    sensors: Sensors
    train: RunPlan
    held_out: RunPlan
    seed: int
    roughness: Roughness = Roughness()

    @property
    def is_dyno(self) -> bool:
        """Whether the height is prescribed and a load cell measures, on no free body."""
        return isinstance(self.train.excitation, Stroke)

    @property
    def nominal(self) -> Bench:
        """The bench as the model file describes it."""
        return self.roughness.applied(self.bench)


class Recording(NamedTuple):
    """One run, measured, with the truth beside it. All arrays have one row a sample.

    Attributes:
        t_s: (n,) time.
        height_m: (n,) measured height: true, noisy, quantised.
        applied_force_n: (n,) measured load: what was commanded, quantised; None on a dyno.
        strut_force_n: (n,) measured by the load cell: true, noisy, quantised; None without one.
        temperature_c: (n,) measured temperature, or None.
        true_height_m: (n,)
        true_velocity_m_per_s: (n,)
        true_acceleration_m_per_s2: (n,)
        effect_force_n: (n, effects) true force of every planted effect, positive up.
    """

    t_s: Samples
    height_m: Samples
    applied_force_n: Samples | None
    strut_force_n: Samples | None
    temperature_c: Samples | None
    true_height_m: Samples
    true_velocity_m_per_s: Samples
    true_acceleration_m_per_s2: Samples
    effect_force_n: Samples
