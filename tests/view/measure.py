"""What the live page costs, and how it grows: `python -m tests.view.measure --out FOLDER`.

Prints how long an hour-long run takes to open, missed ticks and lateness of a live run with and
without a page open (interleaved), and the memory of server and page while a long run is followed.
Requires Chromium and Playwright.
"""

import argparse
import contextlib
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import yaml

from rig.log.step_columns import END_OF_STREAM, step_schema
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.view.browser import browser, drawn, until
from tests.view.serving import make_run

RATE_HZ = 1000
TEXT = """
Headless Chromium opens the page that `rig view` serves, and draws it in software; a browser that
draws with a graphics processor uses less CPU time. No artificial load runs on the cores.

For the time to open the page, a run of one hour is generated: synthetic steps at 1 kHz, in the same
files as those of a live run. The time runs from the request of the page until the whole run is
drawn.

For the effect on a run, live runs of {seconds} s at 1 kHz (bridge and simulated bench in one
process, on a virtual bus) alternate between no page and one open page. Missed ticks and lateness
are compared within each pair.

The memory of the server is its anonymous resident memory (RssAnon); the memory of the page is the
JavaScript heap after a garbage collection.
"""
ADDRESS = re.compile(r"http://\S+")


def hour(folder):
    """A run of an hour, its steps made up and its files as a live run leaves them."""
    make_run(folder, 50)
    with (folder / "steps.arrow").open("rb") as file:
        schema = pa.ipc.open_stream(file).schema
    count, rng = 3600 * RATE_HZ, np.random.default_rng(1)
    t_s = np.arange(count) / RATE_HZ
    wave = 0.4 + 0.05 * np.sin(2.0 * np.pi * 2.0 * t_s) + 1e-5 * rng.standard_normal(count)
    common = {"t_ns": t_s * 1e9, "received": 1, "mode": 2}
    with (folder / "steps.arrow").open("wb") as file:
        file.write(schema.serialize().to_pybytes())
        for begin in range(0, count, 191):
            part = slice(begin, min(begin + 191, count))
            length = part.stop - begin
            columns = []
            for field in schema:
                given = common.get(field.name, 0 if field.name in step_schema().names else wave)
                values = (
                    np.broadcast_to(given, count)[part]
                    if np.ndim(given)
                    else np.full(length, given)
                )
                columns.append(pa.array(values.astype(field.type.to_pandas_dtype())))
            file.write(bytes(pa.RecordBatch.from_arrays(columns, schema=schema).serialize()))
        file.write(END_OF_STREAM)
    header = yaml.safe_load((folder / "run.yaml").read_text())
    (folder / "run.yaml").write_text(yaml.safe_dump(header))


@contextlib.contextmanager
def view(folder):
    """`rig view` as a process of its own."""
    call = ["-m", "rig", "view", folder, "--port", 0, "--no-browser"]
    with subprocess.Popen(
        [sys.executable, *map(str, call)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process, ADDRESS.search(process.stdout.readline()).group()
        finally:
            process.terminate()


def opening_s(folder):
    """Time from asking for the page to the whole run drawn."""
    with view(folder) as (_, address), browser() as made:
        page = made.new_page()
        begin = time.monotonic()
        page.goto(address)
        drawn(page)
        until(page, "view.end - view.begin > 3599")
        return time.monotonic() - begin


def live(folder, seconds):
    """A live run as a process of its own."""
    call = ["-m", "tests.realtime", "--out", folder, "--seconds", seconds, "--busy", 0]
    return subprocess.Popen([sys.executable, *map(str, call)], stdout=subprocess.PIPE, text=True)


def figures(text):
    """Missed ticks, and lateness p99.9 in µs."""
    missed = int(re.search(r"(\d+) overruns", text).group(1))
    return missed, float(re.search(r"lateness_us: .*'p99_9': ([\d.]+)", text).group(1))


def pair(folder, seconds):
    """A run without a page, and one with a page open."""
    with live(folder / "without", seconds) as process:
        without = figures(process.communicate()[0])
    with view(folder / "with" / "run") as (_, address), browser() as made:
        page = made.new_page(viewport={"width": 1400, "height": 900})
        page.goto(address)
        with live(folder / "with", seconds) as process:
            drawn(page)
            return without, figures(process.communicate()[0])


def rss_mib(pid):
    """Resident memory of a process that is no shared mapping of a file."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"RssAnon:\s+(\d+)", text).group(1)) / 1024


def grow(folder, minutes):
    """Memory of server and page, MiB, at every minute of a live run; printed on the way."""
    rows = []
    with view(folder / "long" / "run") as (server, address), browser() as made:
        page = made.new_page()
        page.goto(address)
        with live(folder / "long", 60 * minutes + 10) as process:
            drawn(page)
            session = page.context.new_cdp_session(page)
            for minute in range(minutes + 1):
                session.send("HeapProfiler.collectGarbage")
                heap = page.evaluate("performance.memory.usedJSHeapSize") / 2**20
                rows.append((minute, f"{rss_mib(server.pid):.1f}", f"{heap:.1f}"))
                print("{:3d} min: server {} MiB, page {} MiB".format(*rows[-1]), flush=True)
                if minute < minutes:
                    page.wait_for_timeout(60_000)
            process.communicate()
    return rows


def listed(items):
    """Items as a list in a sentence."""
    *first, last = items
    return f"{', '.join(first)} and {last}" if first else last


def conclusion(pairs, seconds):
    """What the pairs show of the missed ticks."""
    differences = [with_page[0] - without[0] for without, with_page in pairs]
    numbers = listed(f"{it:+d}" for it in differences)
    found = f"Missed ticks with a page less those without: {numbers}."
    if min(differences) > 0:
        return f"{found} In every pair, more ticks are missed with a page."
    return (
        f"{found} Not every pair has more missed ticks with a page: {len(pairs)} pairs of "
        f"{seconds} s do not show a cost of the page."
    )


def write_page(opened_s, pairs, memory, seconds):
    """Write the guide's page."""
    times = listed(f"{time_s:.2f} s" for time_s in opened_s)
    parts = [f"The run of one hour opened in {times}, in {len(opened_s)} tries."]
    if pairs:
        ticks = RATE_HZ * seconds
        heads = ("pair", f"missed ticks (of {ticks}) without a page", "missed ticks with a page")
        lateness = ("lateness p99.9 without a page, µs", "lateness p99.9 with a page, µs")
        rows = [
            (number, without[0], with_page[0], f"{without[1]:.0f}", f"{with_page[1]:.0f}")
            for number, (without, with_page) in enumerate(pairs, start=1)
        ]
        parts += [table((*heads, *lateness), rows), conclusion(pairs, seconds)]
    if memory:
        heads = ("minutes after the start of a live run", "server, MiB", "page, MiB")
        parts.append(table(heads, memory))
    text = TEXT.format(seconds=seconds)
    write_evidence("page", "What the live page of `rig view` costs", text, parts, command_line())


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--minutes", type=int, default=30)
    add_page_option(parser)
    given = parser.parse_args()
    given.out.mkdir(parents=True)
    hour(given.out / "hour")
    opened_s = [opening_s(given.out / "hour") for _ in range(3)]
    print("hour-long run opened in", *(f"{time_s:.2f} s" for time_s in opened_s))
    pairs, memory = [], []
    for number in range(given.pairs):
        without, with_page = pair(given.out / f"pair{number}", given.seconds)
        pairs.append((without, with_page))
        print(
            f"pair {number}: missed {without[0]} without, {with_page[0]} with a page; "
            f"lateness p99.9 {without[1]:.0f} and {with_page[1]:.0f} µs",
            flush=True,
        )
    if given.minutes:
        memory = grow(given.out, given.minutes)
    if given.page:
        write_page(opened_s, pairs, memory, given.seconds)


if __name__ == "__main__":
    main()
