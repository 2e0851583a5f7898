"""A Dask cluster on loopback: a scheduler and workers, each a process of its own."""

import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from distributed import Client


class Cluster(NamedTuple):
    """What runs.

    Attributes:
        address: Of the scheduler.
        scheduler: Its process.
        workers: Theirs.
    """

    address: str
    scheduler: "subprocess.Popen[bytes]"
    workers: list["subprocess.Popen[bytes]"]


@contextmanager
def cluster(folder: Path, workers: int) -> Generator[Cluster]:
    """A cluster of single-threaded workers without nannies, so that a killed one stays away."""
    file = folder / "scheduler.json"
    log = (folder / "cluster.log").open("wb")
    said = {"stdout": log, "stderr": subprocess.STDOUT}
    own = [sys.executable, "-W", "ignore", "-m", "distributed.cli.dask_scheduler"]
    quiet = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    scheduler = subprocess.Popen([*own, *quiet, "--port", "0"], **said)
    started: list[subprocess.Popen[bytes]] = []
    try:
        while not file.exists():
            if scheduler.poll() is not None:
                raise RuntimeError((folder / "cluster.log").read_text())
            time.sleep(0.1)
        one = [sys.executable, "-W", "ignore", "-m", "distributed.cli.dask_worker"]
        one += ["--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", "--no-dashboard"]
        one += ["--host", "127.0.0.1", "--local-directory", str(folder)]
        started += [subprocess.Popen(one, **said) for _ in range(workers)]
        with Client(scheduler_file=str(file)) as client:
            client.wait_for_workers(workers, timeout=120)
            address = client.scheduler.address
        yield Cluster(address, scheduler, started)
    finally:
        for process in (*started, scheduler):
            process.kill()
            process.wait()
        log.close()
