"""CAN interfaces, as a person would treat them with `ip` and `tc`; and frames as the kernel has them."""

import shutil
import struct
import subprocess
from functools import partial

FRAME = struct.Struct("=IB3x8s")  # can_id, length, data: linux/can.h


def _run(tool: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [shutil.which(tool) or f"/usr/sbin/{tool}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


ip, tc = partial(_run, "ip"), partial(_run, "tc")


def must(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 0, done.stderr


def frame(can_id: int, data: bytes = b"") -> bytes:
    return FRAME.pack(can_id, len(data), data)
