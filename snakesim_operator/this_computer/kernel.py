"""Findings of `snakesim doctor` about the kernel: what delays a control loop.

They are read from /proc and /sys below a folder, so that a test can describe another computer.
"""

import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from snakesim_operator.this_computer.computer import ComputerFinding

MAX_FTDI_LATENCY_MS = 1  # the driver's default of 16 ms is longer than a tick at 100 Hz
ROOT = Path("/")


def check_kernel(root: Path = ROOT) -> Iterator[ComputerFinding]:
    """Yield findings about preemption, processor clocks, isolated processors, serial adapters and their ports."""
    yield from _check_preemption(root)
    yield from _check_governor(root)
    yield from _check_isolated_processors(root)
    yield from _check_serial_adapters(root)
    yield from _check_serial_ports(root)


def _check_preemption(root: Path) -> Iterator[ComputerFinding]:
    version = _read_text_or_none(root / "proc/version")
    if version is None:
        return
    if _read_text_or_none(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        yield ComputerFinding(what="kernel", state="ok", detail="PREEMPT_RT")
        return
    detail = "not PREEMPT_RT: ticks may be milliseconds late; `snakesim topic rate` shows it (docs/how-to/real-time.md)"
    yield ComputerFinding(
        what="kernel", state="warn", detail=detail, fix=["sudo apt install linux-image-rt-amd64"]
    )


def _check_governor(root: Path) -> Iterator[ComputerFinding]:
    paths = (root / "sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor")
    governors = {_read_text_or_none(path) for path in paths} - {None}
    if not governors:
        yield ComputerFinding(
            what="governor",
            state="ok",
            detail="not known: this kernel does not set the processors' clock",
        )
    elif governors == {"performance"}:
        yield ComputerFinding(what="governor", state="ok", detail="performance")
    else:
        names = ", ".join(sorted(name for name in governors if name))
        detail = f"{names}: a processor that has slowed down takes longer for the first ticks"
        yield ComputerFinding(
            what="governor",
            state="warn",
            detail=detail,
            fix=["sudo cpupower frequency-set -g performance"],
        )


def _check_isolated_processors(root: Path) -> Iterator[ComputerFinding]:
    isolated = _read_text_or_none(root / "sys/devices/system/cpu/isolated")
    if isolated:
        detail = f"{isolated} without other programs; a host uses them when started with `taskset -c {isolated}`"
    else:
        detail = f"none of {os.cpu_count()}; isolate one for the host from 500 Hz on (docs/how-to/real-time.md)"
    yield ComputerFinding(what="isolated processors", state="ok", detail=detail)


def _check_serial_adapters(root: Path) -> Iterator[ComputerFinding]:
    """Yield a finding for each FTDI adapter, whose driver collects bytes for `latency_timer` milliseconds."""
    for timer in sorted((root / "sys/bus/usb-serial/devices").glob("*/latency_timer")):
        latency_ms = _read_text_or_none(timer) or ""
        port = timer.parent.name
        if latency_ms.isdecimal() and int(latency_ms) > MAX_FTDI_LATENCY_MS:
            fix = [f"echo {MAX_FTDI_LATENCY_MS} | sudo tee {timer}"]
            detail = f"{port} holds back what it received for up to {latency_ms} ms"
            yield ComputerFinding(what="serial adapter", state="warn", detail=detail, fix=fix)
        else:
            yield ComputerFinding(
                what="serial adapter",
                state="ok",
                detail=f"{port}: latency timer {latency_ms or '?'} ms",
            )


def _check_serial_ports(root: Path) -> Iterator[ComputerFinding]:
    """Yield a finding for each serial port of a USB adapter."""
    folder = root / "dev"
    for port in sorted([*folder.glob("ttyUSB*"), *folder.glob("ttyACM*")]):
        yield _check_serial_port(port)


def _check_serial_port(port: Path) -> ComputerFinding:
    """Check whether this user may open a serial port, and whether another program has locked it."""
    try:
        file_descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        fix = [f"ls -l {port}"]
        if error.errno == errno.EACCES:
            fix = ["sudo usermod -aG dialout $USER    # then log in again"]
        detail = f"{port.name} cannot be opened: {error.strerror}"
        return ComputerFinding(what="serial port", state="warn", detail=detail, fix=fix)
    try:
        fcntl.flock(file_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        detail = f"{port.name} is in use by another program"
        return ComputerFinding(
            what="serial port", state="warn", detail=detail, fix=[f"sudo fuser -v {port}"]
        )
    finally:
        os.close(file_descriptor)
    return ComputerFinding(what="serial port", state="ok", detail=f"{port.name} can be opened")


def _read_text_or_none(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None
