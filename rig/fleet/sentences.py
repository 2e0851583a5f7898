"""What a store says, in sentences."""

from typing import NamedTuple

from rig.fleet.overview import Jump, Outlier, Overview, Series, date_of
from rig.fleet.trends import EDGE, FEWEST, ChangePoint, Drift


def alarm_sentences(found: Overview) -> list[str]:
    """A sentence for each jump, change, drift and outlier, the surest first."""
    changes = [(s.change.p, s, s.change) for s in found.series if s.is_change and s.change]
    drifts = [(s.drift.p, s, s.drift) for s in found.series if s.is_drift and s.drift]
    lines = [_jump_sentence(jump) for jump in found.jumps]
    lines += [_change_sentence(s, change) for _, s, change in sorted(changes)]
    lines += [_drift_sentence(s, line) for _, s, line in sorted(drifts)]
    lines += [
        f"{series_name(item)} is {item.value:.4g}, usual is {item.usual:.4g}"
        for item in found.outliers
    ]
    return lines


class PowerRow(NamedTuple):
    """What cannot be seen of a quantity, in words: scatter from run to run, drift and step."""

    quantity: str
    dampers: int
    runs: str
    scatter: str
    drift: str
    step: str


def power_rows(found: Overview) -> list[PowerRow]:
    """A row for each quantity."""
    return [
        PowerRow(
            power.quantity,
            power.dampers,
            f"{power.runs:g}",
            _percent(power.scatter, "–"),
            _percent(power.drift_per_month, "any, three days needed", "< ", " a month"),
            _percent(power.step, f"any, {FEWEST} runs needed, {EDGE} after it", "< "),
        )
        for power in found.powers()
    ]


def _percent(share: float | None, unknown: str, before: str = "", after: str = "") -> str:
    """A share in per cent with two digits, or what is said where it is not known."""
    if share is None:
        return unknown
    percent = 100.0 * share
    digits = f"{percent:.0f}" if percent >= 10.0 else f"{percent:.2g}"
    return f"{before}{digits} %{after}"


def series_name(item: Series | Outlier) -> str:
    """Which damper, and what of it."""
    return f"Damper {item.where.damper} on {item.where.bench}: {item.quantity.words}"


def _jump_sentence(jump: Jump) -> str:
    change = jump.change
    return (
        f"Bench {jump.bench}: {jump.parameter} of its dampers steps by "
        f"{100 * (jump.factor - 1):+.1f} % on {date_of(change.day)} ({date_of(change.low)} to "
        f"{date_of(change.high)}): its calibration, not the dampers, whose forces are counted "
        "without it"
    )


def _change_sentence(item: Series, change: ChangePoint) -> str:
    what = (
        f"steps from {change.before:.4g} to {change.after:.4g}"
        if change.kind == "step"
        else f"bends from {change.before:.4g} to {change.after:.4g} at the end"
    )
    return (
        f"{series_name(item)} {what}, from {date_of(change.day)} on "
        f"({date_of(change.low)} to {date_of(change.high)})"
    )


def _drift_sentence(item: Series, line: Drift) -> str:
    share = 700.0 / abs(line.level) if line.level else 0.0
    return (
        f"{series_name(item)} drifts by {share * line.per_day:+.2f} % a week "
        f"({share * line.low:+.2f} to {share * line.high:+.2f})"
    )
