"""Findings of `snakesim doctor` about the kernel: what keeps a control loop from running when it is due.

Read from /proc and /sys of a folder, so that a test can lay out another computer.
"""

import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from snakesim_operator.this_computer.computer import Finding

FTDI_LATENCY_MS = 1  # the driver's default of 16 ms is longer than a tick at 100 Hz
ROOT = Path("/")


def kernel(root: Path = ROOT) -> Iterator[Finding]:
    """Preemption, clock of the processors, processors set aside, serial adapters and their ports."""
    yield from _preemption(root)
    yield from _governor(root)
    yield from _isolated(root)
    yield from _serial_adapters(root)
    yield from _serial_ports(root)


def _preemption(root: Path) -> Iterator[Finding]:
    words = _read(root / "proc/version")
    if words is None:
        return
    if _read(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in words:
        yield Finding(what="kernel", state="ok", detail="PREEMPT_RT")
        return
    detail = "not PREEMPT_RT: a tick may begin milliseconds late; `snakesim top` shows how late (docs/real-time.md)"
    yield Finding(what="kernel", state="warn", detail=detail, fix=["sudo apt install linux-image-rt-amd64"])


def _governor(root: Path) -> Iterator[Finding]:
    found = {_read(path) for path in (root / "sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor")} - {None}
    if not found:
        yield Finding(what="governor", state="ok", detail="not known: this kernel does not set the processors' clock")
    elif found == {"performance"}:
        yield Finding(what="governor", state="ok", detail="performance")
    else:
        names = ", ".join(sorted(name for name in found if name))
        detail = f"{names}: a processor that has slowed down takes longer for the first ticks"
        yield Finding(what="governor", state="warn", detail=detail, fix=["sudo cpupower frequency-set -g performance"])


def _isolated(root: Path) -> Iterator[Finding]:
    apart = _read(root / "sys/devices/system/cpu/isolated")
    if apart:
        detail = f"{apart} kept free of other programs; a host uses them when started with `taskset -c {apart}`"
    else:
        detail = f"none of {os.cpu_count()}; from 500 Hz on one for the host alone is worth it (docs/real-time.md)"
    yield Finding(what="isolated processors", state="ok", detail=detail)


def _serial_adapters(root: Path) -> Iterator[Finding]:
    """FTDI's driver collects bytes for `latency_timer` milliseconds, unless told otherwise."""
    for timer in sorted((root / "sys/bus/usb-serial/devices").glob("*/latency_timer")):
        latency_ms, port = _read(timer) or "", timer.parent.name
        if latency_ms.isdecimal() and int(latency_ms) > FTDI_LATENCY_MS:
            fix = [f"echo {FTDI_LATENCY_MS} | sudo tee {timer}"]
            detail = f"{port} holds back what it received for up to {latency_ms} ms"
            yield Finding(what="serial adapter", state="warn", detail=detail, fix=fix)
        else:
            yield Finding(what="serial adapter", state="ok", detail=f"{port}: latency timer {latency_ms or '?'} ms")


def _serial_ports(root: Path) -> Iterator[Finding]:
    """Whether ports of adapters may be opened, and nobody else has them for himself."""
    for port in sorted(path for name in ("ttyUSB*", "ttyACM*") for path in (root / "dev").glob(name)):
        try:
            number = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            fix = ["sudo usermod -aG dialout $USER    # then log in again"] if error.errno == errno.EACCES else []
            detail = f"{port.name} cannot be opened: {error.strerror}"
            yield Finding(what="serial port", state="warn", detail=detail, fix=fix or [f"ls -l {port}"])
            continue
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            detail, fix = f"{port.name} is in use by another program", [f"sudo fuser -v {port}"]
            yield Finding(what="serial port", state="warn", detail=detail, fix=fix)
        else:
            yield Finding(what="serial port", state="ok", detail=f"{port.name} can be opened")
        finally:
            os.close(number)


def _read(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None
