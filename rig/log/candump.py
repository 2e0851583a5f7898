"""A line of `frames.log`: candump's log format, with ns and the direction at its end."""

from can_dbc.frame import Frame
from rig.log.errors import LogError

LATEST_S = 9_000_000_000
"""Unix time beyond which a stamp is wrong: in ns it would hardly go into 64 bits."""


def format_frame(frame: Frame, epoch_ns: int, channel: str, direction: str) -> str:
    """A line of candump's log format, with ns and the direction (R or T) at the end."""
    seconds, ns = divmod(frame.t_ns + epoch_ns, 1_000_000_000)
    if frame.is_error:
        identifier = f"{frame.arbitration_id | 0x20000000:08X}"
    else:
        identifier = f"{frame.arbitration_id:0{8 if frame.is_extended else 3}X}"
    separator = f"##{1 if frame.bitrate_switch else 0:X}" if frame.is_fd else "#"
    payload = frame.data.hex().upper()
    return f"({seconds}.{ns:09d}) {channel} {identifier}{separator}{payload} {direction}\n"


def parse_frame(line: str, epoch_ns: int) -> tuple[Frame, str]:
    """A frame and its direction from a line of candump's log format.

    Raises:
        ValueError: The line is not a valid line of that format.
    """
    stamp, _, rest = line.strip().split(" ", 2)
    text, _, direction = rest.partition(" ")
    seconds, _, fraction = stamp.strip("()").partition(".")
    if not (stamp.startswith("(") and stamp.endswith(")") and 1 <= len(fraction) <= 9):
        raise ValueError(f"time stamp {stamp!r}")
    if not 0 <= int(seconds) < LATEST_S:
        raise ValueError(f"time stamp {stamp!r}")
    t_ns = int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0")) - epoch_ns
    identifier, mark, payload = text.partition("#")
    if not mark or len(identifier) not in (3, 8):
        raise ValueError(f"frame {text!r}")
    number = int(identifier, 16)
    is_fd = payload.startswith("#")
    flags = int(payload[1], 16) if is_fd else 0
    data = bytes.fromhex(payload[2:] if is_fd else payload)
    if len(data) > (64 if is_fd else 8):
        raise ValueError(f"payload of {len(data)} bytes")
    is_error = len(identifier) == 8 and bool(number & 0x20000000)
    is_extended = len(identifier) == 8 and not is_error
    frame = Frame(t_ns, number & 0x1FFFFFFF, data, is_extended, is_fd, bool(flags & 1), is_error)
    return frame, direction if direction in ("R", "T") else "R"


def line_error(where: str, line: str) -> LogError:
    """The error of a line that is no frame; `where` is its file and number."""
    return LogError(
        f"{where}: {line.strip()[:60]!r}: expected a line such as '(1.000000000) can0 100#0102 R'"
    )
