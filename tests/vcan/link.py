"""CAN interfaces, as a person would treat them with `ip` and `tc`; and frames as the kernel has them."""

import shutil
import struct
import subprocess

FRAME = struct.Struct("=IB3x8s")  # can_id, length, data: linux/can.h


def ip(*arguments: str) -> subprocess.CompletedProcess[str]:
    return _run("ip", arguments)


def tc(*arguments: str) -> subprocess.CompletedProcess[str]:
    return _run("tc", arguments)


def must(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 0, done.stderr


def frame(can_id: int, data: bytes = b"") -> bytes:
    return FRAME.pack(can_id, len(data), data)


def _run(tool: str, arguments: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
    command = [shutil.which(tool) or f"/usr/sbin/{tool}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
