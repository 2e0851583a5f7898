"""`rig tune` but for its words: from a configuration and a run to a configuration."""

import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml

from can_dbc.codec import si_step
from can_dbc.errors import InputError
from can_dbc.units import Dimension
from can_dbc.yaml_file import parse_mapping, read_text
from rig.bridge.free_model import strut_answers
from rig.closed_loop.loop import Rhythm
from rig.diagnosis.progress import Progress, within
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.plan.assembly import arrivals, build_plant
from rig.plan.setup import Setup, setup_of_folder
from rig.tuning.expectation import Expectation, of_run, stated
from rig.tuning.gains import (
    Aim,
    Bench,
    Expected,
    Tuned,
    bandwidth_hz,
    expected,
    paper,
    swept,
    tuned,
)
from rig.tuning.latency import Latency, delayed, estimate_latency

_FIRST_CORNER_PER_INTERVAL = 0.1
"""Bandwidth in rad/s times the interval of the observers that are not tuned yet: quick and tame."""

_FACTORS = tuple(2.0 ** (step / 6.0) for step in range(-15, 16))
"""Of the bandwidths that are drawn: from a sixth to six times the choice."""

_LONGEST_DELAY_S = 0.05
"""That is looked for: a height that is older is not one to close a loop with."""


class Stated(NamedTuple):
    """What somebody expects of the residual force who has no run.

    Attributes:
        rms_n: Its root mean square.
        up_to_hz: Its highest frequency.
        noise_std_m: Standard deviation of the height; by the DBC's resolution if None.
    """

    rms_n: float
    up_to_hz: float
    noise_std_m: float | None = None


@dataclass(frozen=True)
class TunedStrut:
    """A strut whose observer was tuned.

    Attributes:
        name: Its name.
        expectation: What it was tuned for.
        latency: Delay of its height as the run shows it; None where it was given.
        delay_s: Delay that it was tuned with.
        found: The observer.
        paper: What is expected of the published gains, scaled by the effective mass.
        bandwidth_hz: Bandwidth of the observer.
        sweep: What is expected at other bandwidths.
    """

    name: str
    expectation: Expectation
    latency: Latency | None
    delay_s: float
    found: Tuned
    paper: Expected
    bandwidth_hz: float
    sweep: list[tuple[float, Expected]]


def tune(
    ready: Setup, source: Path | Stated, kind: str, aim: Aim, progress: Progress
) -> list[TunedStrut]:
    """Tune the observer of every strut.

    Args:
        ready: The configuration.
        source: A run of the bench, or what is expected of it.
        kind: One of `rig.tuning.gains.KINDS`.
        aim: What the loops must keep.
        progress: Called with what is being done, and the share that is done.

    Raises:
        InputError: The run cannot be used.
    """
    if ready.config.prescribed_motion is not None:
        raise InputError(
            f"{ready.source}: prescribed_motion: no loop is closed, expected a free model"
        )
    names = list(ready.config.observers)
    if len(names) > len(ready.config.signals.height):
        raise InputError(
            f"{ready.source}: observers: kind none beside others cannot be tuned, expected a "
            "height of each strut"
        )
    plant = build_plant(ready)
    heights = [strut.free_length_m for strut in ready.model.struts]
    answers = strut_answers(plant, heights)
    progress("reading what is to be expected", 0.0)
    expectations = [
        _expectation(ready, source, name, answer.mobility_per_kg)
        for name, answer in zip(names, answers, strict=True)
    ]
    every = arrivals(ready)
    first = tuple(
        KalmanObserver("kalman", _first_filter(item.noise_std_m, arrival.interval_ns))
        for item, arrival in zip(expectations, every, strict=True)
    )
    found: list[TunedStrut] = []
    for index, name in enumerate(names):
        share = index / len(names), (index + 1) / len(names)
        part = within(progress, *share, of=name)
        mobility_per_kg = answers[index].mobility_per_kg
        latency = _latency(ready, source, name, mobility_per_kg, first[index], part)
        delay_s = ready.config.signals.height[name].delay_s
        if latency is not None and latency.low_s > 0.0:
            delay_s = float(f"{latency.delay_s:.3g}")
        part("gains", 0.7)
        interval_ns, limit = every[index].interval_ns, cast("Any", ready.config.observers[name])
        bench = Bench(
            plant,
            first,
            index,
            answers,
            heights,
            Rhythm.of(ready.config.period_ns, interval_ns, round(delay_s * 1e9)),
            expectations[index],
            limit.force_limit_n,
        )
        best = tuned(bench, kind, aim)
        part("other bandwidths", 0.9)
        found.append(
            TunedStrut(
                name,
                expectations[index],
                latency,
                delay_s,
                best,
                expected(bench, paper(bench)),
                bandwidth_hz(best.observer, mobility_per_kg),
                swept(bench, best.observer, _FACTORS),
            )
        )
    return found


def _expectation(
    ready: Setup, source: Path | Stated, name: str, mobility_per_kg: float
) -> Expectation:
    if isinstance(source, Path):
        return of_run(source, name, mobility_per_kg)
    noise_std_m = source.noise_std_m or _quantisation_m(ready, name)
    return stated(noise_std_m, source.rms_n, source.up_to_hz)


def _latency(
    ready: Setup,
    source: Path | Stated,
    name: str,
    mobility_per_kg: float,
    observer: KalmanObserver,
    progress: Progress,
) -> Latency | None:
    """The latency of a height; None where there is no run, or the configuration gives it."""
    if not isinstance(source, Path) or ready.config.signals.height[name].delay_s:
        return None
    # The run's own signals and bus, with the model that is tuned.
    own = setup_of_folder(source).model_copy(update={"model": ready.model})
    return estimate_latency(
        source,
        own,
        name,
        mobility_per_kg,
        observer,
        _LONGEST_DELAY_S,
        lambda share: progress("latency", 0.7 * share),
    )


def write_config(ready: Setup, found: list[TunedStrut], path: Path) -> None:
    """Write the configuration with the tuned observers; comments are lost.

    Args:
        ready: The configuration.
        found: The observers.
        path: New file, in the folder of the configuration: what it names lies beside it.

    Raises:
        InputError: The file exists, lies elsewhere or cannot be written.
    """
    if path.absolute().parent != ready.source.absolute().parent:
        raise InputError(f"--out {path}: expected a file beside {ready.source}: it names others")
    content = parse_mapping(read_text(ready.source), str(ready.source))
    content["observers"] = {strut.name: plain(strut.found.observer) for strut in found}
    late = {strut.name: strut.delay_s for strut in found if strut.latency and strut.delay_s}
    if late:
        signals = cast("dict[str, Any]", content["signals"])
        signals["height"] = {
            name: entry.model_dump(exclude_defaults=True)
            | ({"delay_s": late[name]} if name in late else {})
            for name, entry in ready.config.signals.height.items()
        }
        supervision = delayed(ready, max(late.values())).config.supervision
        content["supervision"] = cast("dict[str, Any]", content.get("supervision") or {}) | {
            "stale_after_s": round(supervision.stale_after_s, 9),
            "safe_after_s": round(supervision.safe_after_s, 9),
        }
    try:
        with path.open("x", encoding="utf-8") as file:
            yaml.safe_dump(content, file, sort_keys=False)
    except OSError as error:
        raise InputError(f"--out {path}: {os.strerror(error.errno or 0)}") from error


def plain(observer: Any) -> dict[str, Any]:
    """An observer as it stands in a configuration; what is absent or zero there is left out."""
    return {key: value for key, value in asdict(observer).items() if value}


def _first_filter(noise_std_m: float, interval_ns: int) -> ErrorFilter:
    corner = _FIRST_CORNER_PER_INTERVAL / (interval_ns * 1e-9)
    return ErrorFilter.within(corner / (2.0 * math.pi), noise_std_m)


def _quantisation_m(ready: Setup, name: str) -> float:
    """Standard deviation of the rounding of a height to its signal's steps."""
    entry = ready.config.signals.height[name]
    step_m = si_step(ready.database.message(entry.message), entry.signal, Dimension.LENGTH)
    if step_m <= 0.0:
        raise InputError(
            f"{entry.message}.{entry.signal}: has no steps to take the noise from, expected "
            "--noise-std-m"
        )
    return step_m / 12.0**0.5
