"""Authenticated frames: what is forged, replayed or out of order gets no further."""

import dataclasses
from collections.abc import Callable

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bus.link import Link
from rig.bus.secoc import Authentication, Authenticator, cmac, read_key
from rig.log.file_names import STEPS_FILE
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check
from rig.run.live import with_bench
from rig.run.loop import RunControl
from rig.run.ports import BusPort
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from tests.bus_and_log.at_once import AtOnce

MS = 1_000_000
S = 1000 * MS
KEY = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")
EPOCH_NS = 1_800_000_000 * S
PROFILE_1 = Authentication(KEY, 1, 3, 100 * MS)

MESSAGE = bytes.fromhex(
    "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
    "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
)


@pytest.mark.parametrize(
    ("length", "expected"),
    [
        (0, "bb1d6929e95937287fa37d129b756746"),
        (16, "070a16b46b4d4144f79bdd9dd04a287c"),
        (40, "dfa66747de9ae63030ca32611497c827"),
        (64, "51f0bebf7e3b9d92fc49741779363cfe"),
    ],
)
def test_vectors_of_rfc_4493(length, expected):
    assert cmac(KEY)(MESSAGE[:length]).hex() == expected


def sender(epoch_ns: int = EPOCH_NS) -> Callable[[int, bytes], Frame]:
    """Secures a payload at a time."""
    authenticator = Authenticator(PROFILE_1, epoch_ns)
    return lambda t_ns, data: authenticator.secure(Frame(t_ns, 0x100, data))


def receiver(epoch_ns: int = EPOCH_NS) -> Authenticator:
    return Authenticator(PROFILE_1, epoch_ns)


def payloads(authenticator, frames):
    return [frame.data for frame in authenticator.authenticate(frames)]


@given(
    datas=st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=20),
    gaps_ms=st.lists(st.integers(0, 5000), min_size=20, max_size=20),
)
def test_what_was_sent_comes_back_whatever_was_lost_before(datas, gaps_ms):
    send, heard, t_ns = sender(), receiver(), 0
    for data, gap_ms in zip(datas, gaps_ms, strict=False):
        t_ns += gap_ms * MS
        frame = send(t_ns, data)
        assert len(frame.data) == 12
        assert frame.is_fd
        assert payloads(heard, [frame]) == [data]


def test_every_flipped_bit_is_refused():
    frame = sender()(0, bytes(8))
    heard = receiver()
    for bit in range(96):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        assert payloads(heard, [replace(frame, data=bytes(data))]) == []
    assert heard.unauthentic == 96
    assert payloads(heard, [frame]) == [bytes(8)]


def test_another_key_another_id_and_another_length_are_refused():
    heard = receiver()
    other = Authenticator(Authentication(bytes(16), 1, 3, 100 * MS), EPOCH_NS)
    frame = sender()(0, bytes(8))
    assert heard.authenticate([other.secure(Frame(0, 0x100, bytes(8)))]) == []
    assert heard.authenticate([replace(frame, arbitration_id=0x101)]) == []
    assert (
        heard.authenticate([replace(frame, data=frame.data[:length]) for length in range(12)]) == []
    )
    assert heard.authenticate([Frame(0, 0x100, bytes(8))]) == []
    assert heard.unauthentic == 15


def test_a_frame_is_accepted_once():
    send, heard = sender(), receiver()
    frames = [send(k * MS, bytes([k] * 8)) for k in range(50)]
    assert len(heard.authenticate(frames)) == 50
    again = [replace(frame, t_ns=frame.t_ns + 50 * MS) for frame in frames]
    assert heard.authenticate(again) == []
    assert heard.replayed == 50


def test_a_recording_is_refused_also_after_a_restart():
    send = sender()
    frames = [send(k * MS, bytes(8)) for k in range(100)]
    later = receiver(EPOCH_NS + S)
    assert later.authenticate(frames) == []
    assert later.unauthentic == 100


def test_an_overtaken_frame_is_refused():
    send, heard = sender(), receiver()
    first, second = send(0, bytes(8)), send(MS, bytes(8))
    assert len(heard.authenticate([second, first])) == 1
    assert heard.replayed == 1


def test_a_sender_that_was_restarted_is_believed_at_once():
    heard = receiver()
    send = sender()
    assert len(heard.authenticate([send(k * MS, bytes(8)) for k in range(500)])) == 500
    # The new one counts from its own start, 3 s later, and its clock is 20 ms ahead.
    again = sender(EPOCH_NS + 3 * S + 20 * MS)
    frames = [replace(again(k * MS, bytes(8)), t_ns=3 * S + k * MS) for k in range(500)]
    assert len(heard.authenticate(frames)) == 500


@pytest.mark.parametrize(("offset_ms", "accepted"), [(-99, 5), (99, 5), (-140, 0), (140, 0)])
def test_clocks_may_be_apart_by_the_tolerance(offset_ms, accepted):
    send, heard = sender(EPOCH_NS + offset_ms * MS), receiver()
    assert len(heard.authenticate([send(k * MS, bytes(8)) for k in range(5)])) == accepted


def test_frames_that_are_held_back_by_more_and_more_are_refused_when_they_are_too_old():
    send, receiving = sender(), receiver()
    # A gateway stretches time by half: after 40 s a frame is 20 s old, and none came abruptly.
    sent_ns = [10 * MS * k for k in range(4000)]
    late = [replace(send(t_ns, bytes(8)), t_ns=t_ns * 3 // 2) for t_ns in sent_ns]
    accepted = receiving.authenticate(late)
    ages_ns = [frame.t_ns - frame.t_ns * 2 // 3 for frame in accepted]
    assert 0.95 * S < max(ages_ns) <= PROFILE_1.max_age_ns == S
    assert receiving.replayed > 0
    assert receiving.replayed + receiving.unauthentic == 4000 - len(accepted)
    # Without the gateway the next frame is believed at once.
    assert payloads(receiving, [send(60 * S, b"directly")]) == [b"directly"]


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_clocks_that_drift_apart_are_followed_up_to_a_bound(drift):
    how = dataclasses.replace(PROFILE_1, max_age_ns=500 * MS)
    send, receiving = sender(), Authenticator(how, EPOCH_NS)
    # 10 s apart, with clocks that differ by 1 ms more each time.
    frames = [
        replace(send(round(k * 10 * S * (1 + drift)), bytes(8)), t_ns=k * 10 * S)
        for k in range(1000)
    ]
    assert len(receiving.authenticate(frames)) == 501
    assert receiving.replayed > 0


def test_a_clock_that_was_slow_and_is_set_is_believed_at_once():
    send, receiving = sender(), receiver()
    slow = [replace(send(k * 990 * MS, bytes(8)), t_ns=k * S) for k in range(51)]
    assert len(receiving.authenticate(slow)) == 51
    assert payloads(receiving, [send(51 * S, b"set")]) == [b"set"]


@pytest.mark.parametrize(("bits", "tolerance_ms"), [(8, 100), (8, 819), (16, 10_000)])
def test_a_forged_frame_costs_a_bounded_number_of_tries(bits, tolerance_ms):
    how = Authentication(KEY, bits // 8, 3, tolerance_ms * MS, 60 * S)
    receiving, slow = Authenticator(how, EPOCH_NS), Authenticator(how, EPOCH_NS - tolerance_ms * MS)
    # The clocks are apart, so that all about the one is tried and all about the other.
    assert payloads(receiving, [slow.secure(Frame(0, 0x100, b"first"))]) == [b"first"]
    tried = []
    right = receiving._cmac
    receiving._cmac = lambda message: tried.append(message) or right(message)
    assert receiving.authenticate([Frame(S, 0x100, bytes(12), is_fd=True)]) == []
    assert len(tried) == len(set(tried)) <= 2 * (64 + 1)


def test_more_frames_than_the_clock_has_steps_are_each_newer_than_the_last():
    send, receiving = sender(), receiver()
    assert len(receiving.authenticate([send(0, bytes(8)) for _ in range(100)])) == 100


class Wire:
    """A bus whose frames are put into it, and that keeps what is sent."""

    epoch_ns = EPOCH_NS
    listens_only = False

    def __init__(self):
        self.frames, self.sent = [], []

    def receive(self, elapsed_ns):
        frames, self.frames = self.frames, []
        return frames

    def send(self, frame):
        self.sent.append(frame)


def test_a_refused_frame_is_told_as_a_fault_of_the_bus_for_one_tick():
    wire = Wire()
    port = BusPort(Link(lambda: wire, lambda: EPOCH_NS, AtOnce(), receiver()))
    wire.frames = [Frame(0, 0x100, bytes(12), is_fd=True)]
    frames, conditions = port.receive(0)
    assert frames == []
    assert conditions.bus_fault
    wire.frames = [sender()(MS, b"measured")]
    frames, conditions = port.receive(MS)
    assert [frame.data for frame in frames] == [b"measured"]
    assert not conditions.bus_fault
    sent = port.send([Frame(MS, 0x110, b"estimate")])
    assert sent == [Frame(MS, 0x110, b"estimate")]
    assert payloads(receiver(), wire.sent) == [b"estimate"]
    assert port.link.figures.as_dict()["unauthentic"] == 1


@pytest.fixture
def configured(tmp_path):
    """The reference case's configuration with other keys, and a key file beside it."""

    def write(**keys):
        config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
        config["bus"] = {
            "interface": "virtual",
            "channel": tmp_path.name,
            "bitrate": 1_000_000,
            "data_bitrate": 5_000_000,
        }
        config["authentication"] = {"key_file": "bench.key"}
        path = tmp_path / "secured.yaml"
        path.write_text(yaml.safe_dump(config | keys))
        key = tmp_path / "bench.key"
        key.write_text(KEY.hex() + "\n")
        key.chmod(0o600)
        return path

    return write


def in_lockstep(path, folder):
    with_bench(
        load_plan(path, duration_s=0.3),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        folder,
        lockstep=True,
        control=RunControl(progress=lambda _t_ns, _mode: None),
    )
    return (folder / STEPS_FILE).read_bytes()


def test_the_estimate_is_the_same_with_and_without(configured, tmp_path):
    plain = in_lockstep(configured(authentication=None), tmp_path / "plain")
    secured = in_lockstep(configured(), tmp_path / "secured")
    assert secured == plain
    (tmp_path / "bench.key").unlink()
    assert replay(tmp_path / "secured").different == 0
    for path in (tmp_path / "secured").iterdir():
        assert KEY not in path.read_bytes()
        assert KEY.hex().encode() not in path.read_bytes().lower()


def test_the_check_tells_of_it(configured):
    path = configured()

    def found():
        [finding] = [item for item in check(load_plan(path)) if item.what == "authentication"]
        return finding

    assert found().severity is Severity.OK
    assert "24 bits" in found().text
    (path.parent / "bench.key").chmod(0o644)
    assert found().severity is Severity.ERROR
    assert KEY.hex() not in found().text


def test_the_plan_of_a_run_is_checked_without_its_key(configured):
    path = configured()
    plan = load_plan(path)
    assert plan.authentication.key == KEY
    assert KEY.hex() not in repr(plan)
    assert plan.with_config(plan.config).authentication == plan.authentication
    (path.parent / "bench.key").unlink()  # the folder of a run contains none
    findings = check(dataclasses.replace(plan, authentication=None))
    assert not [item for item in findings if item.severity is Severity.ERROR]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"bus": {"interface": "virtual", "channel": "x"}}, "expected bus.data_bitrate"),
        ({"authentication": {"key_file": "bench.key", "mac_bits": 32}}, "13 bytes long"),
        ({"authentication": {"key_file": "bench.key", "mac_bits": 16}}, "authentication.mac_bits"),
        (
            {"authentication": {"key_file": "bench.key", "clock_tolerance_s": 5}},
            r"secured\.yaml: authentication\.clock_tolerance_s: 5: expected at most 0\.82",
        ),
    ],
)
def test_a_configuration_that_cannot_work_is_refused(configured, keys, said):
    with pytest.raises(InputError, match=said):
        load_plan(configured(**keys))


@pytest.mark.parametrize(
    ("keys", "max_age_ns"),
    [
        ({}, S),
        ({"max_age_s": 0.3}, 300 * MS),
        ({"clock_tolerance_s": 0.5, "max_age_s": 0.3}, 500 * MS),
        ({"clock_tolerance_s": 5, "freshness_bits": 16, "mac_bits": 48}, 5 * S),
    ],
)
def test_the_largest_age_is_a_setting(configured, keys, max_age_ns):
    plan = load_plan(configured(authentication={"key_file": "bench.key", **keys}))
    assert plan.authentication.max_age_ns == max_age_ns


@pytest.mark.parametrize("text", ["", "00" * 15, "00" * 17, "zz" * 16, KEY.hex()[:-1]])
def test_a_wrong_key_is_refused_without_repeating_it(tmp_path, text):
    path = tmp_path / "bench.key"
    path.write_text(text)
    with pytest.raises(InputError, match="expected a key of 32 hexadecimal digits") as caught:
        read_key(path)
    assert not text or text not in str(caught.value)
    assert caught.value.__cause__ is None


def test_a_key_is_not_shown():
    assert KEY.hex() not in repr(PROFILE_1)
    assert str(KEY) not in repr(PROFILE_1)
