"""Virtual CAN interfaces of the kernel, or a skip that says what is missing."""

import shutil
import subprocess
from collections.abc import Iterator

import pytest

TOOLS = ("ip", "candump", "canplayer", "cangen", "cangw", "cansend")


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


def _up(name: str) -> None:
    subprocess.run(["ip", "link", "add", "dev", name, "type", "vcan"], check=True)
    subprocess.run(["ip", "link", "set", "up", name], check=True)


@pytest.fixture
def vcan(_kernel_with_vcan: None) -> Iterator[str]:
    """A fresh interface, up."""
    _up("vcan0")
    yield "vcan0"
    subprocess.run(["ip", "link", "delete", "vcan0"], check=False)


@pytest.fixture
def second_vcan(_kernel_with_vcan: None) -> Iterator[str]:
    """Another one, for what a gateway joins."""
    _up("vcan1")
    yield "vcan1"
    subprocess.run(["ip", "link", "delete", "vcan1"], check=False)
