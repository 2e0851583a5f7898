"""Every second of a record: which step it belongs to, or why it belongs to none.

A figure that is missing because its step was left out must not be missing in silence. Each sample
is part of a step, of a rest, of a transition (the machine on its way between steps and rests), or
of strokes that were rejected, with the reason.
"""

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from rig.dyno.strokes import Array, Block, Stroke

Use = Literal["step", "rest", "transition", "rejected"]

_MOST_IN_TRANSITION = 4
"""Strokes of no step in a row that a machine takes to get from one step to the next: half a cycle
at the end and at the beginning, and a cycle in which it builds up the amplitude."""

_LONGEST = 2.0
"""Times the longest stroke of the steps next to it that a stroke of a transition lasts."""


class Span(NamedTuple):
    """A stretch of a record, from `begin_s` to `end_s`.

    Attributes:
        number: Number of the step, from 1; 0 if it is none.
        why: Reason of a rejection; empty otherwise.
    """

    begin_s: float
    end_s: float
    use: Use
    number: int = 0
    why: str = ""


def account(
    t_s: Array,
    strokes: Sequence[Stroke],
    steps: Sequence[Block],
    rejected: Mapping[int, str],
    rests: Sequence[slice],
) -> tuple[Span, ...]:
    """The whole of a record as spans, in time, without gaps between them.

    Args:
        t_s: Times, increasing, shape (N,).
        strokes: All strokes of the record.
        steps: Blocks that gave figures, in time.
        rejected: Why a block gave none, by the first sample of each of its strokes.
        rests: Samples at rest.
    """
    uses = np.zeros(len(t_s), np.int64)  # 0: transition; above: steps; below: what `texts` holds
    texts: dict[int, tuple[Use, str]] = {-1: ("rest", "")}
    for rest in rests:
        uses[rest] = -1
    used = {stroke.first for block in steps for stroke in block.strokes}
    for group in _group_unused(strokes, used, rests):
        whys = [rejected[stroke.first] for stroke in group if stroke.first in rejected]
        if not whys and _is_transition(group, steps):
            continue
        code = -2 - len(texts)
        unlike = f"{len(group)} strokes in a row, whose amplitude, duration or shape changes"
        texts[code] = ("rejected", whys[0] if whys else unlike)
        inside = slice(group[0].first, group[-1].last + 1)
        uses[inside] = np.where(uses[inside] == 0, code, uses[inside])
    for number, block in enumerate(steps, start=1):
        uses[block.begin : block.end] = number
    begins = np.concatenate([[0], np.flatnonzero(np.diff(uses)) + 1])
    spans: list[Span] = []
    for begin, end in zip(begins, [*begins[1:], len(t_s) - 1], strict=True):
        code = int(uses[begin])
        use, why = texts.get(code, ("step" if code > 0 else "transition", ""))
        spans.append(Span(float(t_s[begin]), float(t_s[end]), use, max(code, 0), why))
    return tuple(spans)


def _is_transition(group: Sequence[Stroke], steps: Sequence[Block]) -> bool:
    """Whether strokes are few, and not slower than those of the steps before and after them."""
    if len(group) == 1 or len(group) > _MOST_IN_TRANSITION:
        return len(group) == 1
    before = [block for block in steps if block.begin <= group[0].first][-1:]
    after = [block for block in steps if block.begin > group[0].first][:1]
    usual_s = [stroke.duration_s for block in (*before, *after) for stroke in block.strokes]
    longest_s = max(stroke.duration_s for stroke in group)
    return longest_s <= _LONGEST * max(usual_s, default=0.0)


def _group_unused(
    strokes: Sequence[Stroke], used: set[int], rests: Sequence[slice]
) -> list[list[Stroke]]:
    """Strokes of no step that follow one another, without a rest among them."""
    groups: list[list[Stroke]] = [[]]
    for stroke in strokes:
        has_rest = any(rest.start < stroke.last and rest.stop > stroke.first for rest in rests)
        if stroke.first in used or has_rest:
            groups.append([])
        else:
            groups[-1].append(stroke)
    return [group for group in groups if group]


def words(span: Span) -> str:
    """A span that is rejected, in words."""
    return f"{span.begin_s:.2f} to {span.end_s:.2f} s gave no step: {span.why}"
