"""`rig tune` but for its words: from a configuration and a run to a configuration."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml

from can_dbc.codec import si_step
from can_dbc.units import Dimension
from rig.core.closed_loop import Rhythm
from rig.core.observers.kalman import KalmanObserver
from rig.core.observers.model_error import ErrorFilter
from rig.core.step import strut_answers
from rig.inputs.errors import InputError
from rig.inputs.yaml_file import parse_mapping, read_text
from rig.operation.assembly import arrivals, build_plant
from rig.operation.setup import Setup, setup_of_folder
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

Progress = Callable[[str, float], None]

_FIRST_CORNER_PER_INTERVAL = 0.1
"""Bandwidth in rad/s times the interval of the observers that are not tuned yet: quick and tame."""

_FACTORS = tuple(2.0 ** (step / 6.0) for step in range(-15, 16))
_LONGEST_DELAY_S = 0.05


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
        paper: The published gains scaled by the effective mass, and what is expected of them.
        bandwidth_hz: Bandwidth of the observer.
        paper_hz: Natural frequency of the published gains.
        sweep: What is expected at other bandwidths.
    """

    name: str
    expectation: Expectation
    latency: Latency | None
    delay_s: float
    found: Tuned
    paper: tuple[Any, Expected]
    bandwidth_hz: float
    paper_hz: float
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
    plant = build_plant(ready)
    heights = [strut.free_length_m for strut in ready.model.struts]
    mobilities = [answer.mobility_per_kg for answer in strut_answers(plant, heights)]
    names = list(ready.config.observers)
    if len(names) > len(ready.config.signals.height):
        raise InputError(
            f"{ready.source}: observers: kind none beside others cannot be tuned, expected a "
            "height of each strut"
        )
    expectations: list[Expectation] = []
    for index, name in enumerate(names):
        if isinstance(source, Path):
            progress(f"reading {name}", 0.0)
            expectations.append(of_run(source, name, mobilities[index]))
        else:
            noise = source.noise_std_m or _quantisation_m(ready, name)
            expectations.append(stated(noise, source.rms_n, source.up_to_hz))
    every = arrivals(ready)
    first = [
        KalmanObserver("kalman", _first_filter(item.noise_std_m, arrival.interval_ns))
        for item, arrival in zip(expectations, every, strict=True)
    ]
    found: list[TunedStrut] = []
    for index, name in enumerate(names):

        def part(what: str, share: float, index: int = index, name: str = name) -> None:
            progress(f"{name}: {what}", (index + share) / len(names))

        delay_s = ready.config.signals.height[name].delay_s
        latency = None
        if isinstance(source, Path) and delay_s == 0.0:
            latency = estimate_latency(
                source,
                _with_model_of(ready, source),
                name,
                mobilities[index],
                first[index],
                _LONGEST_DELAY_S,
                lambda share, part=part: part("latency", 0.7 * share),
            )
            if latency.low_s > 0.0:
                delay_s = float(f"{latency.delay_s:.3g}")
        part("gains", 0.7)
        rhythm = _rhythm(ready, every[index].interval_ns, delay_s)
        limit_n = cast("Any", ready.config.observers[name]).force_limit_n
        bench = Bench(
            plant,
            tuple(first),
            index,
            mobilities[index],
            heights,
            rhythm,
            expectations[index],
            limit_n,
        )
        best = tuned(bench, kind, aim)
        part("other bandwidths", 0.9)
        published = paper(bench)
        found.append(
            TunedStrut(
                name,
                expectations[index],
                latency,
                delay_s,
                best,
                (published, expected(bench, published)),
                bandwidth_hz(best.observer, mobilities[index]),
                bandwidth_hz(published, mobilities[index]),
                swept(bench, best.observer, _FACTORS),
            )
        )
    return found


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
    found: dict[str, Any] = {}
    for key in observer.__dataclass_fields__:
        value = getattr(observer, key)
        if value is None or value == 0.0:
            continue
        found[key] = plain(value) if hasattr(value, "__dataclass_fields__") else value
    return found


def _with_model_of(ready: Setup, run: Path) -> Setup:
    """The run's own signals and bus, with the model and the observers that are tuned."""
    own = setup_of_folder(run)
    return own.model_copy(update={"model": ready.model})


def _first_filter(noise_std_m: float, interval_ns: int) -> ErrorFilter:
    corner = _FIRST_CORNER_PER_INTERVAL / (interval_ns * 1e-9)
    return ErrorFilter.within(corner / (2.0 * math.pi), noise_std_m)


def _rhythm(ready: Setup, interval_ns: int, delay_s: float) -> Rhythm:
    every = max(1, round(interval_ns / ready.config.period_ns))
    delay = round(delay_s * 1e9 / (every * ready.config.period_ns))
    return Rhythm(ready.config.period_ns, every, delay)


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
