"""Findings of `snakesim doctor` about the computer: each reports what is there, and how to fix it.

`fail` means that no run is possible, and `warn` that something is missing which some users need.
"""

import ctypes
import importlib.metadata
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import msgspec

from snakesim_hal.base.process import (
    HOST_PRIORITY,
    lock_memory,
    make_child_environment,
    make_python_command,
    set_parent_death_signal,
)
from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_operator.base import extras

MIN_PYTHON = (3, 11)
PROBE_TIMEOUT_S = 30.0
ARPHRD_CAN = "280"  # the type of a CAN interface in /sys/class/net, from if_arp.h
IFF_UP = 1  # the flag of an interface that is up, from if.h
ADJTIMEX_TIME_ERROR = 5  # adjtimex returns it if the clock is not synchronized
TIMEX_BYTES = 256  # more than a struct timex
WAKE_UP_COUNT = 100
WAKE_UP_PERIOD_S = 0.001
MAX_WAKE_UP_DELAY_S = 0.002  # a longer one costs a tick at 500 Hz
MIN_OPEN_FILES = 4096
LIMITS_FILE = "/etc/security/limits.d/snakesim.conf"
MB = 1024**2
GB = 1024**3
WARN_FREE_BYTES = GB
MIN_FREE_BYTES = 100 * MB
MAX_ERROR_LENGTH = 100

RENDER_PROBE_PROGRAM = """
import os, mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/><geom size='.1'/></worldbody></mujoco>")
with mujoco.Renderer(model, 32, 32) as renderer:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer.update_scene(data)
    assert renderer.render().max() > 0
"""


PHYSICS_LIBRARY_PROBE_PROGRAM = """
import mujoco
from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_native.load import load_shared_library
print(load_shared_library(LAWS_LIBRARY).problem)
"""


class ComputerFinding(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the report."""

    what: str
    state: Literal["ok", "warn", "fail"]
    detail: str
    fix: list[str] = []  # commands
    code: str | None = None  # of the error that was found


def check_python() -> Iterator[ComputerFinding]:
    """Check the version of the interpreter."""
    detail = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info >= MIN_PYTHON:
        yield ComputerFinding(what="Python", state="ok", detail=detail)
    else:
        fix = ["make setup PYTHON=python3.11"]
        yield ComputerFinding(
            what="Python", state="fail", detail=f"{detail}; 3.11 or newer is needed", fix=fix
        )


def check_packages() -> Iterator[ComputerFinding]:
    """Check whether the packages that SnakeSIM requires, by its package metadata, are installed.

    Yields:
        One finding for the packages of the core, and one for those of each extra.
    """
    # By extra; the packages of the core have the extra "".
    installed_by_extra: dict[str, list[str]] = {}  # names with versions
    missing_by_extra: dict[str, list[str]] = {}  # names
    for requirement in importlib.metadata.requires("snakesim") or []:
        package, extra = _parse_requirement(requirement)
        if package == "snakesim":  # an extra that includes another extra
            continue
        try:
            package_with_version = f"{package} {importlib.metadata.version(package)}"
        except importlib.metadata.PackageNotFoundError:
            missing_by_extra.setdefault(extra, []).append(package)
        else:
            installed_by_extra.setdefault(extra, []).append(package_with_version)
    for extra in sorted({*installed_by_extra, *missing_by_extra}):
        if extra in missing_by_extra:
            yield _make_missing_packages_finding(extra, missing_by_extra[extra])
        else:
            yield ComputerFinding(
                what=_format_packages_label(extra),
                state="ok",
                detail=", ".join(installed_by_extra[extra]),
            )


def _parse_requirement(requirement: str) -> tuple[str, str]:
    """Return the package that a requirement names, and the extra that it belongs to; "" for the core.

    The library `packaging`, which parses all requirements, is none of our dependencies. This is enough for ours: apart
    from extras they have no environment markers.

    Args:
        requirement: A requirement as package metadata has it, such as `numpy>=2; extra == "report"`.
    """
    package = re.split(r"[\[<>=!~; ]", requirement)[0]
    extra_match = re.search(r"""extra == ['"]([^'"]+)""", requirement)
    extra = extra_match[1] if extra_match else ""
    return package, extra


def _make_missing_packages_finding(extra: str, names: list[str]) -> ComputerFinding:
    """Make the finding for missing packages. An extra may be left out on purpose, so it is no failure.

    Args:
        extra: Name of the extra that the packages belong to; empty for the core.
        names: Names of the missing packages.
    """
    what = _format_packages_label(extra)
    packages = ", ".join(names)
    if extra:
        fix = ["make setup", f"python -m pip install 'snakesim[{extra}]'"]
        return ComputerFinding(
            what=what, state="ok", detail=f"left out, needs: {packages}", fix=fix
        )
    fix = ["make setup", "python -m pip install --force-reinstall snakesim"]
    return ComputerFinding(what=what, state="fail", detail=f"missing: {packages}", fix=fix)


def _format_packages_label(extra: str) -> str:
    return f"packages [{extra}]" if extra else "packages"


def check_laws() -> Iterator[ComputerFinding]:
    """Check that the simulator's ground and friction laws run in C."""
    if not extras.is_installed("sim"):
        return
    what = "Physics in C"
    problem = _run_python_program(PHYSICS_LIBRARY_PROBE_PROGRAM)
    if not problem:
        yield ComputerFinding(
            what=what, state="ok", detail="ground and friction are computed in MuJoCo's engine"
        )
        return
    detail = f"{LAWS_LIBRARY.python_cost}, with the same results: {problem}"
    fix = ["sudo apt install gcc libc6-dev", "python -m pip install ziglang"]
    yield ComputerFinding(what=what, state="warn", detail=detail, fix=fix)


def _run_python_program(program: str) -> str:
    """Run a Python program in a process of its own, and return what it prints; else the end of its errors."""
    parent = os.getpid()
    completed = subprocess.run(
        make_python_command("-c", program),
        env=make_child_environment({}),
        capture_output=True,
        text=True,
        timeout=PROBE_TIMEOUT_S,
        check=False,
        preexec_fn=lambda: set_parent_death_signal(parent),
    )
    return completed.stdout.strip() or completed.stderr.strip()[-MAX_ERROR_LENGTH:]


def check_opengl() -> Iterator[ComputerFinding]:
    """Check that MuJoCo can render without a screen. Color images, videos and the model `rendered` need that."""
    if not extras.is_installed("sim"):
        return
    errors: list[str] = []
    for renderer in ("egl", "osmesa"):
        error = _find_render_error(renderer)
        if error is None:
            detail = f"{renderer.upper()} draws without a screen"
            if renderer != "egl":
                detail += f"; set MUJOCO_GL={renderer} for every run"
            yield ComputerFinding(what="OpenGL", state="ok", detail=detail)
            return
        errors.append(f"{renderer.upper()}: {error}")
    detail = f"no color images and videos: {'; '.join(errors)}"
    yield ComputerFinding(
        what="OpenGL", state="warn", detail=detail, fix=["sudo apt install libegl1 libgl1-mesa-dri"]
    )


def _find_render_error(renderer: str) -> str | None:
    """Try to render an image with MuJoCo in a process of its own, because a broken graphics driver may crash it.

    Args:
        renderer: OpenGL library, as MUJOCO_GL names it: "egl" or "osmesa".

    Returns:
        The reason why MuJoCo cannot render with this library; None if it can.
    """
    parent = os.getpid()
    try:
        completed = subprocess.run(
            make_python_command("-c", RENDER_PROBE_PROGRAM),
            env=make_child_environment({"MUJOCO_GL": renderer}),
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT_S,
            check=False,
            preexec_fn=lambda: set_parent_death_signal(parent),
        )
    except subprocess.TimeoutExpired:
        return f"no image within {PROBE_TIMEOUT_S:.0f} s"
    if completed.returncode == 0:
        return None
    error_lines = [line for line in completed.stderr.splitlines() if "Error" in line]
    if not error_lines:
        return f"ended with {completed.returncode}"
    return error_lines[-1][:MAX_ERROR_LENGTH]


def check_can() -> Iterator[ComputerFinding]:
    """Check that the kernel has SocketCAN, and that its interfaces are up.

    Yields:
        One finding. It is a warning if the kernel has no CAN, if there is no interface, or if an interface is down.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        yield _make_no_can_finding(error)
        return
    interfaces = _list_can_interfaces()
    if not interfaces:
        yield ComputerFinding(
            what="CAN", state="warn", detail="no interface", fix=["sudo deploy/can/up.sh vcan0"]
        )
        return
    up_interfaces = [name for name in interfaces if _is_interface_up(name)]
    down_interfaces = [name for name in interfaces if name not in up_interfaces]
    yield ComputerFinding(
        what="CAN",
        state="warn" if down_interfaces else "ok",
        detail=f"up: {', '.join(up_interfaces) or 'none'}",
        fix=[f"sudo ip link set {name} up" for name in down_interfaces],
    )


def _make_no_can_finding(error: OSError) -> ComputerFinding:
    """Make the finding that the kernel has no SocketCAN, from the error of opening a socket."""
    return ComputerFinding(
        what="CAN",
        state="warn",
        detail=(
            f"this kernel has none ({error.strerror}); only real joint modules need it, "
            "`--backend can` emulates them"
        ),
        fix=[
            "sudo modprobe -a can_raw vcan",
            "python3 deploy/vm/with_vcan.py -- .venv/bin/snakesim run triplet --backend can",
        ],
    )


def _list_can_interfaces() -> list[str]:
    """Return the names of the CAN interfaces of this computer."""
    interfaces: list[str] = []
    for type_file in Path("/sys/class/net").glob("*/type"):
        if type_file.read_text().strip() == ARPHRD_CAN:
            interfaces.append(type_file.parent.name)
    return interfaces


def _is_interface_up(name: str) -> bool:
    """Return whether a network interface is up; False if it has disappeared."""
    try:
        flags = int(Path(f"/sys/class/net/{name}/flags").read_text(), 16)
    except (OSError, ValueError):
        return False
    return bool(flags & IFF_UP)


def check_kvm() -> Iterator[ComputerFinding]:
    """Check that virtual machines, in which CAN is tested, are fast."""
    device = Path("/dev/kvm")
    if os.access(device, os.R_OK | os.W_OK):
        yield ComputerFinding(what="KVM", state="ok", detail=f"{device} can be used")
    elif device.exists():
        fix = ["sudo usermod -aG kvm $USER    # then log in again"]
        yield ComputerFinding(
            what="KVM",
            state="warn",
            detail=f"no permission for {device}; VMs for CAN are slow",
            fix=fix,
        )
    else:
        detail = f"no {device}: VMs for CAN are emulated, and slow; switch virtualization on in the BIOS or the cloud"
        yield ComputerFinding(what="KVM", state="warn", detail=detail)


def check_clocks() -> Iterator[ComputerFinding]:
    """Check how late a process without priority wakes up, and whether wall time is synchronized.

    Robot time depends on wake-ups only.
    """
    yield _check_wake_ups()
    if ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)) == ADJTIMEX_TIME_ERROR:
        detail = "not synchronized; only dates of records and of other machines' certificates depend on it"
        yield ComputerFinding(
            what="wall clock", state="warn", detail=detail, fix=["sudo timedatectl set-ntp true"]
        )
    else:
        yield ComputerFinding(what="wall clock", state="ok", detail="synchronized")


def _check_wake_ups() -> ComputerFinding:
    """Sleep many times, and report how late the process wakes up."""
    delays_s: list[float] = []
    for _ in range(WAKE_UP_COUNT):
        expected_wake_up_s = time.monotonic() + WAKE_UP_PERIOD_S
        time.sleep(WAKE_UP_PERIOD_S)
        delays_s.append(time.monotonic() - expected_wake_up_s)
    delays_s.sort()
    median_s = delays_s[WAKE_UP_COUNT // 2]
    p99_s = delays_s[int(0.99 * WAKE_UP_COUNT) - 1]
    detail = (
        f"wake-ups {median_s * 1e6:.0f} us late in the median, {p99_s * 1e6:.0f} us in "
        "99 % (no real-time priority)"
    )
    if p99_s > MAX_WAKE_UP_DELAY_S:
        fix = ["uptime    # is something else running?"]
        return ComputerFinding(what="wake-ups", state="warn", detail=detail, fix=fix)
    return ComputerFinding(what="wake-ups", state="ok", detail=detail)


def check_real_time() -> Iterator[ComputerFinding]:
    """Check that this user may have what host and services need in real time: priority, locked memory, open files."""
    yield _check_priority()
    yield _check_memory_lock()
    yield _check_open_files()


def _check_priority() -> ComputerFinding:
    """Try a real-time priority, and restore the priority of this process."""
    policy_before = os.sched_getscheduler(0)
    parameters_before = os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(HOST_PRIORITY))
        os.sched_setscheduler(0, policy_before, parameters_before)
    except OSError as error:
        detail = (
            f"SCHED_FIFO {HOST_PRIORITY} is refused ({error.strerror}): real-time runs miss "
            "ticks on a busy machine"
        )
        fix = [_format_limit_command(f"rtprio {HOST_PRIORITY}")]
        return ComputerFinding(what="priority", state="warn", detail=detail, fix=fix)
    return ComputerFinding(
        what="priority", state="ok", detail=f"SCHED_FIFO {HOST_PRIORITY} is granted"
    )


def _check_memory_lock() -> ComputerFinding:
    """Try to lock the memory of this process, and unlock it again."""
    refusal = lock_memory()
    ctypes.CDLL(None).munlockall()
    if refusal is None:
        return ComputerFinding(what="memory lock", state="ok", detail="granted")
    return ComputerFinding(
        what="memory lock",
        state="warn",
        detail=refusal,
        fix=[_format_limit_command("memlock unlimited")],
    )


def _check_open_files() -> ComputerFinding:
    soft_limit, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    detail = f"{soft_limit}, at most {hard_limit}"
    if hard_limit == resource.RLIM_INFINITY or hard_limit >= MIN_OPEN_FILES:
        return ComputerFinding(what="open files", state="ok", detail=detail)
    return ComputerFinding(
        what="open files", state="warn", detail=detail, fix=[_format_limit_command("nofile 8192")]
    )


def _format_limit_command(limit: str) -> str:
    """Return the command that raises a limit of this user."""
    return f'echo "$USER - {limit}" | sudo tee -a {LIMITS_FILE}    # then log in again'


def check_disk() -> Iterator[ComputerFinding]:
    """Check that runs can be recorded in the present folder, where `runs/` is made."""
    folder = Path.cwd()
    free_bytes = shutil.disk_usage(folder).free
    if not os.access(folder, os.W_OK):
        yield ComputerFinding(
            what="disk",
            state="warn",
            detail=f"{folder} is read-only; give runs an --out",
            fix=["cd ~"],
        )
        return
    detail = f"{free_bytes / GB:.1f} GB free in {folder}"
    if free_bytes >= WARN_FREE_BYTES:
        yield ComputerFinding(what="disk", state="ok", detail=detail)
        return
    fix = ["du -sh runs/* | sort -h    # and remove what is not needed"]
    state = "warn" if free_bytes >= MIN_FREE_BYTES else "fail"
    yield ComputerFinding(what="disk", state=state, detail=detail, fix=fix)
