"""What a store says, in sentences."""

from rig.fleet.overview import Jump, Outlier, Overview, Series, date_of
from rig.fleet.trends import ChangePoint, Drift


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
