"""A run's log on disks that fail, are slow, or are long in use."""

import errno
import math
import os
import resource
import threading
import time
from functools import partial
from pathlib import Path

import pyarrow as pa
import pytest
import yaml

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.log.captures import CaptureWindow
from rig.log.file_names import FRAMES_FILE, RUN_FILE, STEPS_FILE, part_name, parts
from rig.log.reader import RUN_SCHEMA, read_run
from rig.log.received_frames import read_frame_columns
from rig.log.rotation import Rotation
from rig.log.step_columns import BUS_FAULT, LIMITED, Step
from rig.log.whole_file import WholeFile
from rig.log.writer import MANY_WAITING, LogOptions, RunWriter

MS = 1_000_000
EPOCH_NS = 1_700_000_000_000_000_000
RUNNING, HOLD = 2, 3
COLUMNS = [f"strut.number_{k}" for k in range(11)]


def step(index, mode=RUNNING, flags=0):
    return Step(index * MS, 0, 1, mode, flags, (0.5 + index, float(index), *(math.nan,) * 9))


def tick(index, **options):
    """What is handed over for one tick."""
    t_ns = index * MS
    data = index.to_bytes(8, "big")
    return [Frame(t_ns, 0x100, data)], [Frame(t_ns, 0x110, data)], step(index, **options)


def open_log(folder, *, paced=False, **options):
    header = {"schema": RUN_SCHEMA, "epoch_ns": EPOCH_NS}
    options = LogOptions(**options)
    return RunWriter(folder, header, COLUMNS, "can0", 0 if paced else None, options)


def ending():
    return {"ending": {"status": "done"}}


def assert_holds(folder, first, last):
    """The run holds the frames and the steps of these ticks, and no others."""
    found = read_run(folder)
    expected = [
        (item, way) for i in range(first, last) for item, way in zip(*_frames(i), strict=True)
    ]
    assert list(found.frames()) == expected
    assert found.steps.column("t_ns").to_pylist() == [i * MS for i in range(first, last)]
    columns = read_frame_columns(found.frame_files, found.epoch_ns)
    assert columns.t_ns.tolist() == [i * MS for i in range(first, last)]


def _frames(index):
    received, sent, _ = tick(index)
    return (*received, *sent), ("R", "T")


@pytest.fixture
def file_size_limit():
    """Sets the size at which the kernel lets no file grow: a disk that is full, but for real."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def limit(size_bytes):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))

    yield limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_piece_that_does_not_fit_leaves_no_trace_and_fits_later(tmp_path, file_size_limit):
    file = WholeFile(tmp_path / "x")
    file.append(b"a" * 700)
    file_size_limit(1000)
    with pytest.raises(OSError, match="large"):
        file.append(b"b" * 700)
    assert (tmp_path / "x").read_bytes() == b"a" * 700
    file_size_limit(resource.RLIM_INFINITY)
    file.append(b"b" * 700)
    file.close()
    assert (tmp_path / "x").read_bytes() == b"a" * 700 + b"b" * 700


def test_a_disk_that_is_full_for_a_while_costs_nothing(tmp_path, file_size_limit):
    log = open_log(tmp_path / "run")
    file_size_limit(70_000)
    for index in range(2000):
        log.add(*tick(index))
    assert log.fault is not None
    file_size_limit(resource.RLIM_INFINITY)
    for index in range(2000, 2500):
        log.add(*tick(index))
    assert log.fault is None
    log.close(ending)
    assert "large" in log.trouble
    assert log.dropped == 0
    assert_holds(tmp_path / "run", 0, 2500)


def test_what_was_written_before_the_disk_was_full_stays_readable_and_the_rest_is_counted(
    tmp_path, file_size_limit
):
    log = open_log(tmp_path / "run")
    for index in range(1000):
        log.add(*tick(index))
    file_size_limit(100_000)
    for index in range(1000, 3000):
        log.add(*tick(index))
    log.close(ending)
    found = read_run(tmp_path / "run")
    count = found.steps.num_rows
    assert count >= 800
    assert log.dropped >= 1000
    lines = list(found.frames())
    assert lines == [
        (item, way) for i in range(len(lines) // 2) for item, way in zip(*_frames(i), strict=True)
    ]
    assert found.header["ending"] == {"status": "done"}


def test_how_the_run_ended_is_written_to_a_full_disk_out_of_what_was_kept_back(tmp_path):
    log = open_log(tmp_path / "run")
    assert (tmp_path / "run" / "reserve.tmp").stat().st_size >= 50_000
    log.close(ending)
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "checksums.txt",
        "frames.log",
        "run.yaml",
        "steps.arrow",
    ]


def test_a_slow_disk_holds_nothing_up_and_is_told(tmp_path, monkeypatch):
    released = threading.Event()
    append = WholeFile.append

    def slow(self, piece):
        released.wait(30.0)
        append(self, piece)

    log = open_log(tmp_path / "run", paced=True)
    monkeypatch.setattr(WholeFile, "append", slow)
    for index in range(2 * MANY_WAITING + 1000):
        log.add(*tick(index))
    assert log.fault == "the disk is too slow"
    released.set()
    log.close(ending)
    assert log.dropped == 0
    assert_holds(tmp_path / "run", 0, 2 * MANY_WAITING + 1000)


def test_what_was_handed_over_is_written_while_the_run_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("rig.log.writer._LONGEST_PAUSE_S", None)  # nothing but a tick wakes it
    written = threading.Event()
    append = WholeFile.append

    def told(self, piece):
        append(self, piece)
        if b"R\n" in piece:
            written.set()

    monkeypatch.setattr(WholeFile, "append", told)
    log = open_log(tmp_path / "run", paced=True)
    for index in range(20):
        log.add(*tick(index))
    try:
        assert written.wait(30.0)
    finally:
        log.close(ending)
    assert_holds(tmp_path / "run", 0, 20)


def test_a_folder_that_cannot_be_written_is_refused_before_anything_moves(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/run: cannot be written"):
        open_log(tmp_path / "file" / "run")


@pytest.mark.parametrize(
    "rotation", [Rotation(size_bytes=100_000), Rotation(time_ns=500 * MS), Rotation(1, 1)]
)
def test_a_rotated_run_reads_like_one_that_is_not(tmp_path, rotation):
    log = open_log(tmp_path / "run", rotation=rotation)
    for index in range(3000):
        log.add(*tick(index))
    log.close(ending)
    assert len(read_run(tmp_path / "run").frame_files) > 4
    assert_holds(tmp_path / "run", 0, 3000)


def test_parts_are_read_by_number_also_where_numbers_grow_by_a_digit(tmp_path):
    log = open_log(tmp_path / "run", rotation=Rotation(1, 1))
    for index in range(3000):
        log.add(*tick(index))
    log.close(ending)
    for name in (FRAMES_FILE, STEPS_FILE):
        for number in range(len(parts(tmp_path / "run", name)) - 1, 0, -1):
            path = tmp_path / "run" / part_name(name, number)
            path.rename(path.with_name(part_name(name, 9_995 + number)))
    (tmp_path / "run" / "frames.copy.log").write_text("no part\n")
    names = [path.name for path in read_run(tmp_path / "run").frame_files]
    assert names[4:6] == ["frames.9999.log", "frames.10000.log"]
    assert_holds(tmp_path / "run", 0, 3000)


def test_no_more_parts_are_mapped_than_a_process_can_map(tmp_path, monkeypatch):
    log = open_log(tmp_path / "run", rotation=Rotation(1, 1))
    for index in range(3000):
        log.add(*tick(index))
    log.close(ending)
    mapped = []
    memory_map = pa.memory_map
    monkeypatch.setattr(pa, "memory_map", lambda path: mapped.append(path) or memory_map(path))
    monkeypatch.setattr("rig.log.reader._MOST_MAPPED", 4, raising=False)
    assert_holds(tmp_path / "run", 0, 3000)
    assert [Path(path).name for path in mapped] == [part_name(STEPS_FILE, k) for k in range(4)]


def test_parts_end_with_the_same_tick(tmp_path):
    log = open_log(tmp_path / "run", rotation=Rotation(time_ns=500 * MS))
    for index in range(1200):
        log.add(*tick(index))
    log.close(ending)
    text = (tmp_path / "run" / "frames.log").read_text()
    assert text.count("\n") % 2 == 0
    later = (tmp_path / "run" / "frames.0001.log").read_text()
    assert later.splitlines()[0].endswith("R")


def captured(folder):
    return sorted(path.name for path in (folder / "captures").glob("*"))


class Disk:
    """A disk that is seen to be waited for, and that can fail."""

    def __init__(self, monkeypatch):
        self.synced = []
        self.error = None
        self._again = threading.Event()
        for name in ("fsync", "fdatasync"):
            monkeypatch.setattr(os, name, partial(self._sync, getattr(os, name)))

    def _sync(self, sync, descriptor):
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        self.synced.append((path, path.stat().st_size, threading.current_thread().name))
        self._again.set()
        if self.error is not None:
            raise self.error
        sync(descriptor)

    def wait(self, times=1):
        """Wait until it is waited for again."""
        for _ in range(times):
            self._again.clear()
            assert self._again.wait(20.0)


@pytest.fixture
def disk(monkeypatch):
    return Disk(monkeypatch)


@pytest.fixture
def paced_log(tmp_path):
    """Opens a log with a thread, which ends with the test, also with one that fails."""
    logs = []

    def make(**options):
        logs.append(open_log(tmp_path / "run", paced=True, **options))
        return logs[-1]

    yield make
    for log in logs:
        log._closing.set()


def test_what_was_logged_is_on_the_disk_after_an_interval(disk, paced_log):
    log = paced_log(sync_s=0.05)
    for index in range(500):
        log.add(*tick(index))
    log.note("events.jsonl", "{}\n")
    while (log.folder / STEPS_FILE).stat().st_size < 2000 or log.is_busy:
        disk.wait()
    disk.wait(2 * 5)
    before_the_end = {path: size for path, size, _ in disk.synced}
    for name in (FRAMES_FILE, STEPS_FILE, "events.jsonl"):
        assert before_the_end[log.folder / name] == (log.folder / name).stat().st_size > 0
    assert {log.folder, log.folder / RUN_FILE} <= set(before_the_end)
    # The loop never waits for it.
    assert {thread for _, _, thread in disk.synced} == {"run-log"}
    log.close(ending)
    assert log.trouble is None
    at_the_end = {path: size for path, size, _ in disk.synced}
    for path in (log.folder, *log.folder.iterdir()):
        assert at_the_end[path] == path.stat().st_size


def test_every_file_of_a_rotated_run_is_on_the_disk_before_it_is_closed(tmp_path, disk):
    log = open_log(tmp_path / "run", sync_s=3600.0, rotation=Rotation(time_ns=300 * MS))
    for index in range(1000):
        log.add(*tick(index))
    first = {path.name: size for path, size, _ in disk.synced}
    for name in (FRAMES_FILE, STEPS_FILE):
        assert first[name] == (log.folder / name).stat().st_size
    log.close(ending)


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_disk_that_fails_when_it_is_waited_for_is_a_fault_until_it_works_again(
    disk, paced_log, number
):
    log = paced_log(sync_s=0.05)
    disk.error = OSError(number, os.strerror(number))
    disk.wait(2)
    for index in range(100):  # what is written meanwhile succeeds, and is no sign of health
        log.add(*tick(index))
        time.sleep(0.002)
    assert log.fault == log.trouble == os.strerror(number)
    disk.error = None
    while log.fault is not None:
        disk.wait()
    log.close(ending)
    assert log.trouble == os.strerror(number)
    assert_holds(log.folder, 0, 100)


def test_a_disk_that_fails_at_the_end_is_in_the_record(tmp_path, disk):
    log = open_log(tmp_path / "run", sync_s=1.0)
    log.add(*tick(0))
    disk.error = OSError(errno.EIO, os.strerror(errno.EIO))
    log.close(lambda: {"ending": {"log_fault": log.trouble}})
    assert read_run(log.folder).header["ending"]["log_fault"] == os.strerror(errno.EIO)


def test_no_disk_is_waited_for_where_that_is_left_to_the_system(disk, paced_log):
    log = paced_log()
    log.add(*tick(0))
    log.close(ending)
    assert disk.synced == []


def test_a_window_around_a_fault_is_a_run_of_its_own(tmp_path):
    log = open_log(
        tmp_path / "run",
        window=CaptureWindow(100 * MS, 50 * MS, 10),
        capture_name=lambda before, now: "hold" if now == HOLD != before else None,
    )
    for index in range(1000):
        log.add(*tick(index, mode=HOLD if index in (500, 501, 502) else RUNNING))
    log.close(ending)
    assert captured(tmp_path / "run") == ["001_hold"]
    assert_holds(tmp_path / "run" / "captures" / "001_hold", 400, 551)
    header = yaml.safe_load((tmp_path / "run" / "captures" / "001_hold" / RUN_FILE).read_text())
    assert header["capture"] == {"why": "hold", "t_s": 0.5}


def test_a_users_trigger_a_bus_fault_and_no_more_windows_than_asked_for(tmp_path):
    log = open_log(tmp_path / "run", window=CaptureWindow(10 * MS, 10 * MS, 2))
    for index in range(500):
        if index == 100:
            log.trigger("user")
        log.add(*tick(index, flags=BUS_FAULT if 200 <= index < 250 or index == 400 else 0))
    log.close(ending)
    assert captured(tmp_path / "run") == ["001_user", "002_bus"]
    assert_holds(tmp_path / "run" / "captures" / "002_bus", 190, 211)


def test_a_limit_that_is_passed_opens_a_window_once(tmp_path):
    """As one that only warns does; where it holds the estimate, the mode names the window."""
    log = open_log(
        tmp_path / "run",
        window=CaptureWindow(10 * MS, 10 * MS, 5),
        capture_name=lambda before, now: "hold" if now == HOLD != before else None,
    )
    for index in range(500):
        flags = LIMITED if 100 <= index < 200 or index == 300 else 0
        log.add(*tick(index, flags=flags, mode=HOLD if index == 300 else RUNNING))
    log.close(ending)
    assert captured(tmp_path / "run") == ["001_limit", "002_hold"]
    assert_holds(tmp_path / "run" / "captures" / "001_limit", 90, 111)


def test_a_run_that_ends_within_a_window_keeps_what_there_is(tmp_path):
    log = open_log(tmp_path / "run", window=CaptureWindow(10 * MS, 1000 * MS, 2))
    log.add(*tick(0))
    log.trigger("user")
    log.add(*tick(1))
    log.close(ending)
    assert_holds(tmp_path / "run" / "captures" / "001_user", 0, 2)
