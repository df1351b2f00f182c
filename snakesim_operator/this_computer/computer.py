"""Findings of `snakesim doctor` about the computer: each says what is there, and how to fix it.

`fail`: no run is possible; `warn`: something that some users need is missing.
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
    child_environment,
    die_with_parent,
    lock_memory,
    python_command,
)
from snakesim_operator.base import extras

MIN_PYTHON = (3, 11)
PROBE_LIMIT_S = 30.0
CAN_DEVICE = "280"  # ARPHRD_CAN in if_arp.h
TIME_ERROR = 5  # adjtimex: the clock is not synchronised
TIMEX_BYTES = 256  # more than a struct timex
LATE_WARN_S = 0.002  # a wake-up this late costs a tick at 500 Hz
LIMITS = "/etc/security/limits.d/snakesim.conf"
GB, MB = 1024**3, 1024**2

OPENGL = """
import os, mujoco
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><light/><geom size='.1'/></worldbody></mujoco>")
with mujoco.Renderer(model, 32, 32) as renderer:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer.update_scene(data)
    assert renderer.render().max() > 0
"""


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the report."""

    what: str
    state: Literal["ok", "warn", "fail"]
    detail: str
    fix: list[str] = []  # commands
    code: str | None = None  # of the error that was found


def python() -> Iterator[Finding]:
    """The interpreter."""
    detail = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info >= MIN_PYTHON:
        yield Finding(what="Python", state="ok", detail=detail)
    else:
        detail, fix = f"{detail}; 3.11 or newer is needed", ["make setup PYTHON=python3.11"]
        yield Finding(what="Python", state="fail", detail=detail, fix=fix)


def packages() -> Iterator[Finding]:
    """What SnakeSIM requires, by its own metadata; a line for the core, and one for each extra."""
    lacking: dict[str, list[str]] = {}
    there: dict[str, list[str]] = {}
    for requirement in importlib.metadata.requires("snakesim") or []:
        name = re.split(r"[\[<>=!~; ]", requirement)[0]
        if name == "snakesim":  # an extra that brings another one
            continue
        marker = re.search(r"""extra == ['"]([^'"]+)""", requirement)
        group = marker[1] if marker else ""
        try:
            there.setdefault(group, []).append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            lacking.setdefault(group, []).append(name)
    for group in sorted({*there, *lacking}):
        what = f"packages [{group}]" if group else "packages"
        if missing := lacking.get(group):
            wanted = f"'snakesim[{group}]'" if group else "--force-reinstall snakesim"
            yield Finding(
                what=what,
                state="ok" if group else "fail",  # extras are left out on purpose
                detail=f"{'left out, needs' if group else 'missing'}: {', '.join(missing)}",
                fix=["make setup", f"python -m pip install {wanted}"],
            )
        else:
            yield Finding(what=what, state="ok", detail=", ".join(there[group]))


def opengl() -> Iterator[Finding]:
    """Whether MuJoCo can draw without a screen; only color images, videos and the model `rendered` need that."""
    if not extras.is_installed("sim"):
        return
    detail: list[str] = []
    for kind in ("egl", "osmesa"):
        why = _probe(kind)
        if why is None:
            more = "" if kind == "egl" else "; set MUJOCO_GL=osmesa for every run"
            yield Finding(what="OpenGL", state="ok", detail=f"{kind.upper()} draws without a screen{more}")
            return
        detail.append(f"{kind.upper()}: {why}")
    fix = ["sudo apt install libegl1 libgl1-mesa-dri"]
    yield Finding(what="OpenGL", state="warn", detail=f"no color images and videos: {'; '.join(detail)}", fix=fix)


def _probe(kind: str) -> str | None:
    """Why MuJoCo cannot draw with it; None when it can. In a process of its own: a driver may crash."""
    parent = os.getpid()
    try:
        ended = subprocess.run(
            python_command("-c", OPENGL),
            env=child_environment({"MUJOCO_GL": kind}),
            capture_output=True,
            text=True,
            timeout=PROBE_LIMIT_S,
            check=False,
            preexec_fn=lambda: die_with_parent(parent),
        )
    except subprocess.TimeoutExpired:
        return f"no image within {PROBE_LIMIT_S:.0f} s"
    if ended.returncode == 0:
        return None
    said = [line for line in ended.stderr.splitlines() if "Error" in line]
    return said[-1][:100] if said else f"ended with {ended.returncode}"


def can() -> Iterator[Finding]:
    """SocketCAN: the kernel's part, and the interfaces."""
    vm = "python3 deploy/vm/with_vcan.py -- .venv/bin/snakesim run triplet --backend can"
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        detail = (
            f"this kernel has none ({error.strerror}); only real joint modules need it, `--backend can` emulates them"
        )
        yield Finding(what="CAN", state="warn", detail=detail, fix=["sudo modprobe -a can_raw vcan", vm])
        return
    found = [
        path.parent.name for path in Path("/sys/class/net").glob("*/type") if path.read_text().strip() == CAN_DEVICE
    ]
    if found:
        up = [name for name in found if _is_up(name)]
        down = [name for name in found if name not in up]
        fix = [f"sudo ip link set {name} up" for name in down]
        yield Finding(what="CAN", state="warn" if down else "ok", detail=f"up: {', '.join(up) or 'none'}", fix=fix)
    else:
        yield Finding(what="CAN", state="warn", detail="no interface", fix=["sudo deploy/can/up.sh vcan0"])


def _is_up(name: str) -> bool:
    try:
        return bool(int(Path(f"/sys/class/net/{name}/flags").read_text(), 16) & 1)
    except (OSError, ValueError):
        return False


def kvm() -> Iterator[Finding]:
    """Makes the VM for CAN tests fast."""
    device = Path("/dev/kvm")
    if os.access(device, os.R_OK | os.W_OK):
        yield Finding(what="KVM", state="ok", detail=f"{device} can be used")
    elif device.exists():
        fix = ["sudo usermod -aG kvm $USER    # then log in again"]
        yield Finding(what="KVM", state="warn", detail=f"no permission for {device}; VMs for CAN are slow", fix=fix)
    else:
        detail = f"no {device}: VMs for CAN are emulated, and slow; switch virtualization on in the BIOS or the cloud"
        yield Finding(what="KVM", state="warn", detail=detail)


def clock() -> Iterator[Finding]:
    """Wake-ups of an ordinary process, and whether wall time is right: robot time needs the first only."""
    late: list[float] = []
    for _ in range(100):
        due = time.monotonic() + 0.001
        time.sleep(0.001)
        late.append(time.monotonic() - due)
    late.sort()
    worst_s = late[98]
    detail = (
        f"wake-ups {late[50] * 1e6:.0f} us late in the median, {worst_s * 1e6:.0f} us in 99 % (no real-time priority)"
    )
    yield Finding(
        what="wake-ups",
        state="warn" if worst_s > LATE_WARN_S else "ok",
        detail=detail,
        fix=["uptime    # is something else running?"] if worst_s > LATE_WARN_S else [],
    )
    if ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(TIMEX_BYTES)) == TIME_ERROR:
        detail = "not synchronised; only dates of records and of other machines' certificates depend on it"
        yield Finding(what="wall clock", state="warn", detail=detail, fix=["sudo timedatectl set-ntp true"])
    else:
        yield Finding(what="wall clock", state="ok", detail="synchronised")


def real_time() -> Iterator[Finding]:
    """What the host and the services ask for, and how well they keep time without."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(HOST_PRIORITY))
        os.sched_setscheduler(0, *before)
        yield Finding(what="priority", state="ok", detail=f"SCHED_FIFO {HOST_PRIORITY} is granted")
    except OSError as error:
        fix = [f'echo "$USER - rtprio {HOST_PRIORITY}" | sudo tee -a {LIMITS}    # then log in again']
        detail = f"SCHED_FIFO {HOST_PRIORITY} is refused ({error.strerror}): real-time runs stumble on a busy machine"
        yield Finding(what="priority", state="warn", detail=detail, fix=fix)
    refused = lock_memory()
    ctypes.CDLL(None).munlockall()
    if refused is None:
        yield Finding(what="memory lock", state="ok", detail="granted")
    else:
        fix = [f'echo "$USER - memlock unlimited" | sudo tee -a {LIMITS}    # then log in again']
        yield Finding(what="memory lock", state="warn", detail=refused, fix=fix)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    few = hard != resource.RLIM_INFINITY and hard < 4096
    fix = [f'echo "$USER - nofile 8192" | sudo tee -a {LIMITS}    # then log in again'] if few else []
    yield Finding(what="open files", state="warn" if few else "ok", detail=f"{soft}, at most {hard}", fix=fix)


def disk() -> Iterator[Finding]:
    """Where runs are recorded: `runs/` here, or any `--out`."""
    here = Path.cwd()
    free = shutil.disk_usage(here).free
    if not os.access(here, os.W_OK):
        yield Finding(what="disk", state="warn", detail=f"{here} is read-only; give runs an --out", fix=["cd ~"])
        return
    fix = ["du -sh runs/* | sort -h    # and remove what is not needed"] if free < GB else []
    state = "ok" if free >= GB else "warn" if free >= 100 * MB else "fail"
    yield Finding(what="disk", state=state, detail=f"{free / GB:.1f} GB free in {here}", fix=fix)
