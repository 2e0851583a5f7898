"""What the log's thread asks of the machine: never more than the loop has."""

import os

import pytest

from rig.machine.realtime import follow


@pytest.mark.parametrize(("loop", "asked"), [(50, [49]), (2, [1]), (1, []), (0, [])])
def test_a_thread_runs_just_below_the_loop(monkeypatch, loop, asked):
    priorities = []

    def record(_thread, policy, parameter):
        assert policy & os.SCHED_FIFO
        priorities.append(parameter.sched_priority)

    monkeypatch.setattr(os, "sched_setscheduler", record)
    follow(loop)
    assert priorities == asked
