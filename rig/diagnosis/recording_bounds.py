"""What recordings can determine: facts of each, and bounds of parameters and families of laws."""

from dataclasses import dataclass

_TENTH = 0.1
"""Share of the strut's force at which a family has to be named: what an engineer would miss."""


@dataclass(frozen=True)
class RecordingFacts:
    """One strut of a recording, as measured.

    Attributes:
        recording: Its name.
        strut: Name of the strut.
        duration_s: Time from first to last sample.
        rate_hz: Samples per second.
        missing: Share of heights that are missing.
        clipped: Share of heights that are cut off at an end of the sensor's range.
        low_m: Lowest height.
        high_m: Highest height.
        compression_m_per_s: Speed in compression that is exceeded in a twentieth of the time.
        rebound_m_per_s: The same in rebound.
        rebound_share: Share of the motion (by way) that is rebound at more than a slow creep.
        band_hz: Frequencies between which nine tenths of the velocity's power lie.
        noise_m: Standard deviation of the height sensor's noise.
        resolution_m: Least difference of two heights; None where it is below the noise.
    """

    recording: str
    strut: str
    duration_s: float
    rate_hz: float
    missing: float
    clipped: float
    low_m: float
    high_m: float
    compression_m_per_s: float
    rebound_m_per_s: float
    rebound_share: float
    band_hz: tuple[float, float]
    noise_m: float
    resolution_m: float | None


@dataclass(frozen=True)
class DelayBound:
    """Estimated delay of a channel, if the model lacks no law.

    Attributes:
        channel: As in ``channels`` of a diagnosis.
        delay_s: Estimate, against the applied force, or the height where motion is prescribed.
        std_s: Its standard deviation.
        least_s: From which on a delay is believed although the model may lack laws.
    """

    channel: str
    delay_s: float
    std_s: float
    least_s: float

    @property
    def is_late(self) -> bool:
        """Whether it is late, or early, by more than missing laws feign."""
        return abs(self.delay_s) > self.least_s


@dataclass(frozen=True)
class LinearBound:
    """How well the motion determines a linear parameter.

    Attributes:
        strut: Name of the strut.
        parameter: As in ``linear`` and ``channels`` of a diagnosis.
        nominal: Its value in the model file.
        std: Least standard deviation of an unbiased estimate from these recordings alone.
        prior_std: Standard deviation that the model file states, or a usual one.
        alike: Parameter with which it is correlated by 0.98 or more; None without one.
    """

    strut: str
    parameter: str
    nominal: float
    std: float
    prior_std: float
    alike: str | None

    @property
    def is_determined(self) -> bool:
        """Whether the recordings determine it better than the model file."""
        return self.std < self.prior_std


@dataclass(frozen=True)
class FamilyBound:
    """From which size on a family of laws would be found.

    Attributes:
        family: Family.
        strut: Name of the strut.
        least_n: RMS of its force from which on it would be found.
        least_share: The same as a share of the strut's force by the nominal model.
        rival: Family from which it is distinguished last; None where there is no other.
        apart_n: RMS of its force from which on it is distinguished from that; infinite where never.
        excitation: What a recording that shows it needs.
    """

    family: str
    strut: str
    least_n: float
    least_share: float
    rival: str | None
    apart_n: float
    excitation: str

    @property
    def is_determined(self) -> bool:
        """Whether it would be found, and named, at a tenth of the strut's force."""
        return self.apart_n * self.least_share <= _TENTH * self.least_n


@dataclass(frozen=True)
class Determinable:
    """What recordings can determine together.

    Attributes:
        recordings: Facts of each strut of each recording.
        linear: Bounds of the linear parameters that act.
        families: Bounds of the families that act, those first that are named with the least force.
        unexcited: Families of which no law acts on the recordings.
        delays: What is known of the channels' delays.
        gaps: A line on each recording that has gaps in what drives the bench.
    """

    recordings: tuple[RecordingFacts, ...]
    linear: tuple[LinearBound, ...]
    families: tuple[FamilyBound, ...]
    unexcited: tuple[str, ...]
    delays: tuple[DelayBound, ...]
    gaps: tuple[str, ...]
