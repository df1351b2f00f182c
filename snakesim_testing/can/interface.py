"""Changes CAN interfaces with the Linux tools `ip` and `tc`, and packs frames as the kernel expects them."""

import shutil
import struct
import subprocess

FRAME_LAYOUT = struct.Struct("=IB3x8s")  # id, length and data, as in linux/can.h
TIME_LIMIT_S = 60


def run_ip(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `ip` with these arguments, and return its output and exit status."""
    return _run_tool("ip", *arguments)


def run_tc(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `tc` with these arguments, and return its output and exit status."""
    return _run_tool("tc", *arguments)


def _run_tool(tool: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [shutil.which(tool) or f"/usr/sbin/{tool}", *arguments]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=TIME_LIMIT_S, check=False
    )


def assert_succeeded(completed: subprocess.CompletedProcess[str]) -> None:
    """Fail with the error output of a tool if its exit status is not 0."""
    assert completed.returncode == 0, completed.stderr


def pack_frame(can_id: int, data: bytes = b"") -> bytes:
    """Return a frame as the kernel expects it from a raw CAN socket."""
    return FRAME_LAYOUT.pack(can_id, len(data), data)
