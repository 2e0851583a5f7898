"""Virtual CAN interfaces of the kernel, or a skip that says what is missing."""

import multiprocessing
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import pytest

from rig.bus.bus import BusConfig
from rig.cli.progress import stoppable
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan
from rig.run.live import live, run_bench
from rig.run.logged_run import Ended
from rig.run.loop import Progress, RunControl
from rig.simulated_bench.config import load_bench_config
from tests.slow_reference import write_slow_bridge, write_slow_dbc

TOOLS = ("ip", "candump", "canplayer", "cangen", "cangw", "cansend", "j1939acd")

BENCH_IDS = ("100", "200")


def _missing() -> str | None:
    """Why the tests cannot run here, or None."""
    for tool in TOOLS:
        if shutil.which(tool) is None:
            return f"{tool} is not installed"
    made = subprocess.run(
        ["ip", "link", "add", "dev", "vcan_probe", "type", "vcan"],
        check=False,
        capture_output=True,
        text=True,
    )
    if made.returncode:
        return f"this kernel has no virtual CAN: {made.stderr.strip()}"
    subprocess.run(["ip", "link", "delete", "vcan_probe"], check=True)
    return None


@pytest.fixture(scope="session")
def _kernel_with_vcan() -> None:
    reason = _missing()
    if reason is not None:
        pytest.skip(f"{reason}; .ci/vcan.sh boots a kernel that has all")


@contextmanager
def _interface(name: str) -> Iterator[str]:
    subprocess.run(["ip", "link", "add", "dev", name, "type", "vcan"], check=True)
    subprocess.run(["ip", "link", "set", "up", name], check=True)
    yield name
    subprocess.run(["ip", "link", "delete", name], check=True)


@pytest.fixture(scope="session")
def vcan(_kernel_with_vcan: None) -> Iterator[str]:
    """An interface, up."""
    with _interface("vcan0") as name:
        yield name


@pytest.fixture(autouse=True)
def _nothing_left_behind(request: pytest.FixtureRequest) -> Iterator[None]:
    """Whatever a test did to interface and gateway is undone, also when it failed."""
    yield
    if "vcan" in request.fixturenames:
        subprocess.run(["ip", "link", "set", "up", "vcan0"], check=True)
        subprocess.run(["cangw", "-F"], check=False, capture_output=True)


@pytest.fixture
def three_vcans(vcan: str) -> Iterator[tuple[str, str, str]]:
    """Three of them, for as many benches."""
    with _interface("vcan2") as second, _interface("vcan3") as third:
        yield vcan, second, third


@pytest.fixture
def second_vcan(_kernel_with_vcan: None) -> Iterator[str]:
    """Another one, for what a gateway joins."""
    with _interface("vcan1") as name:
        yield name


class Files(NamedTuple):
    """Files for 100 Hz.

    Attributes:
        dbc: The package's DBC with cycle times of 10 ms.
        bench: The reference case's bench.
        bridge: The reference case's bridge, with gains for this rate, by interface.
    """

    dbc: Path
    bench: Path
    bridge: Callable[[str], Path]


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """The reference case at 100 Hz."""
    folder = tmp_path_factory.mktemp("files")
    dbc = write_slow_dbc(folder)

    def bridge(channel: str) -> Path:
        supervision = {
            "stale_after_s": 0.5,
            "safe_after_s": 5.0,
            # Importing everything again takes minutes in emulation.
            "watchdog": False,
            "limits": [
                {"value": "measured_height_m", "low": 0.1, "high": 0.7, "action": "refuse"},
                # Without a height for the half second until it is stale, the model swings from
                # -0.2 m to 1.3 m, depending on where it was: beyond the range of the signal.
                {"value": "height_m", "low": -2.0, "high": 3.0, "action": "safe"},
            ],
        }
        bus = {"interface": "socketcan", "channel": channel}
        return write_slow_bridge(folder / f"{channel}.yaml", bus, supervision)

    return Files(dbc, CONFIGS / "reference_bench.yaml", bridge)


@contextmanager
def in_process(target: Callable[..., object], *arguments: object) -> Iterator[BaseProcess]:
    """A function in a process of its own, forked: importing all anew takes minutes in emulation."""
    process = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    process.start()
    try:
        yield process
    finally:
        process.terminate()
        process.join(120.0)


def run_until_terminated(bench: Path, channel: str, dbc: Path) -> None:
    """What `rig bench` does."""
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: asked.append(number))
    run_bench(
        load_bench_config(bench),
        BusConfig("socketcan", channel, 500_000),
        dbc,
        RunControl(stop=lambda: bool(asked), progress=lambda _t_ns, _mode: None),
    )


def run_until_signal(config: Path, folder: Path, watchdog: bool) -> None:
    """What `rig run` does until a signal ends it."""
    ready = load_plan(config)
    supervision = ready.config.supervision.model_copy(update={"watchdog": watchdog})
    ready = ready.with_config(ready.config.model_copy(update={"supervision": supervision}))
    with stoppable() as stop:
        live(ready, folder, control=RunControl(stop=stop))


def run_plan(plan: Plan, folder: Path) -> None:
    """What `rig run` does."""
    live(plan, folder, control=RunControl(progress=lambda _t_ns, _mode: None))


@pytest.fixture(scope="session")
def bench(vcan: str, files: Files) -> Iterator[str]:
    """The interface with a bench on it, in a process of its own, while the tests run."""
    with in_process(run_until_terminated, files.bench, vcan, files.dbc) as process:
        subprocess.run(["candump", "-n", "1", vcan], check=True, timeout=300.0)
        yield vcan
        assert process.is_alive()


@pytest.fixture
def bridge(files: Files, tmp_path: Path) -> Callable[..., Ended]:
    """Runs a bridge on an interface for a time."""

    def run(
        channel: str,
        seconds: float,
        *,
        progress: Progress = lambda _t_ns, _mode: None,
        stop: Callable[[], bool] = lambda: False,
        listen_only: bool = False,
        safe_after_s: float | None = None,
    ) -> Ended:
        ready: Plan = load_plan(files.bridge(channel), duration_s=seconds)
        if safe_after_s is not None:
            supervision = ready.config.supervision.model_copy(update={"safe_after_s": safe_after_s})
            ready = ready.with_config(ready.config.model_copy(update={"supervision": supervision}))
        return live(
            ready,
            tmp_path / "run",
            listen_only=listen_only,
            control=RunControl(stop=stop, progress=progress),
        )

    return run
