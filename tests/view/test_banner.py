"""The banner: mode, cause and action of a run, for a glance."""

import pytest

from rig.bridge.values import Mode
from rig.pages.mode_words import TONES, describe_cause
from rig.pages.view.banner import make_banner

CONFIG = {
    "bus": {"channel": "can0"},
    "signals": {"height": {"strut": {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT"}}},
    "observers": {"strut": {}},
}
LIVE = ("live", "Being written.")


def entered(mode, t_s, **cause):
    return {"t_s": t_s, "from": "RUNNING", "to": mode, **cause}


def shown(*events, mode, now_s=10.0, config=CONFIG):
    made = make_banner(LIVE, (mode, now_s), config, events)
    return made._replace(text=made.text.replace("\u00a0", " "))


def test_running_says_that_the_force_is_valid():
    made = shown(entered("RUNNING", 0.3, cause="settled"), mode=Mode.RUNNING)
    assert made == ("good", "✓", "RUNNING", "since 0.3 s. Force output valid.", "")


def test_waiting_names_the_frame_and_its_bus():
    made = shown(entered("WAITING", 4.6), mode=Mode.WAITING)
    assert made.text.startswith("for BENCH_MEASUREMENT on can0, 5 s.")
    assert made.request == ""


@pytest.mark.parametrize(
    ("cause", "text"),
    [
        (
            {"cause": "timeout", "quantity": "age_s", "value": 0.501, "limit": 0.5},
            "no valid measurement for 501 ms (limit 500 ms)",
        ),
        (
            {"cause": "beyond_safe", "quantity": "innovation_m", "value": 0.0101, "limit": 0.01},
            "height error (innovation) 10.1 mm (limit 10 mm)",
        ),
        (
            {"cause": "beyond_safe", "quantity": "force_n", "value": -1510.0, "limit": -1500.0},
            "estimated force −1\u202f510 N (limit −1\u202f500 N)",
        ),
        (
            {"cause": "beyond_safe", "quantity": "force_difference_n", "value": 3.0, "limit": 8.0},
            "difference of estimated force and load cell was beyond 8 N",
        ),
        (
            {"cause": "interlock_open", "quantity": "interlock", "value": 0.0, "limit": 1.0},
            "interlock",
        ),
        ({"cause": "log_lost"}, "the run can no longer be logged"),
        ({"cause": "diverged"}, "the model diverged"),
    ],
)
def test_safe_names_its_cause_and_the_acknowledgement(cause, text):
    made = shown(entered("SAFE", 6.7, **cause), mode=Mode.SAFE)
    assert (made.tone, made.sign, made.word) == ("bad", "✕", "SAFE")
    assert made.text.startswith("since 6.7 s: ")
    assert text in made.text
    assert made.request == "acknowledge"


def test_a_strut_is_named_where_there_are_several():
    event = entered("HOLD", 1.0, cause="beyond_hold", strut="front", quantity="force_n", value=9.0)
    assert "front" not in shown(event, mode=Mode.HOLD).text
    two = {**CONFIG, "observers": {"front": {}, "rear": {}}}
    assert "strut front" in shown(event, mode=Mode.HOLD, config=two).text


def test_a_run_that_has_ended_says_how():
    event = entered("SAFE", 6.7, cause="timeout", quantity="age_s", value=0.501, limit=0.5)
    made = make_banner(("safe", "Ended in its safe state."), (Mode.SAFE, 9.0), CONFIG, [event])
    assert made.word == "ENDED IN SAFE"
    assert "No valid measurement for" in made.text
    assert make_banner(("done", "Ended in order."), None, CONFIG, []).tone == "good"
    assert make_banner(LIVE, None, CONFIG, []).word == "STARTING"


def test_every_mode_has_its_sign_and_no_cause_is_left_in_code():
    assert len(set(TONES.values())) >= 6
    for cause in ("stale", "ticks_missing", "overloaded", "device_fault", "unsettled", "withheld"):
        assert "_" not in describe_cause({"cause": cause})
