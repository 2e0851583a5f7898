"""What a store says, in sentences."""

from rig.fleet.overview import Jump, Outlier, Overview, Power, Series, date_of
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


def power_sentences(found: Overview) -> list[str]:
    """A sentence for each quantity on the changes that cannot be seen in it."""
    return [_power_sentence(power) for power in found.powers()]


def _power_sentence(power: Power) -> str:
    begin = f"{power.quantity}, {power.runs:g} runs a damper"
    if power.drift_per_month is None:
        return f"{begin}: any drift or step, until there are runs on three days"
    drift = f"a drift of less than {100 * power.drift_per_month:.2g} % a month"
    if power.step is None:
        return f"{begin}: {drift}; any step, until there are {FEWEST} runs, {EDGE} of them after it"
    return f"{begin}: {drift}, a step of less than {100 * power.step:.2g} %"


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
