"""Boots a guest, runs one command in it, and passes on the output of the command.

The guest's root is the host's file system, read-only; what the guest writes stays in its memory, except in the
folders that it may write. It keeps what it has read: a file that the host changes meanwhile may be seen or not.
The guest reaches no network; through a forwarded port the host reaches the guest.
"""

import ctypes
import os
import re
import selectors
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from deploy.vm import cpio
from deploy.vm.kernel import (
    BOOT_MODULES,
    CAN_MODULES,
    CONTROLLER_MODULES,
    INPUT_MODULES,
    NETWORK_MODULES,
    Kernel,
    load_order,
)
from deploy.vm.packages import need_tool

SCRIPTS = Path(__file__).parent
PORTS = ("out", "err", "control", "console")
CONSOLE_TAIL = 4000
DRAIN_LIMIT_S = 10.0
CONTROLLERS = ("can0", "can1")
BITRATE = 1_000_000
CONTROLLER_QUEUE = 1000

# Nobody attacks a test's guest, so what guards against it is left out: that halves the cost of a system call.
# On a busy host the emulated timer ticks too late for the check of it at boot, which then panics: no_timer_check.
KERNEL_OPTIONS = "console=ttyS0 quiet loglevel=3 panic=-1 no_timer_check mitigations=off nokaslr cryptomgr.notests"
EMULATION = ("-accel", "tcg,thread=multi,tb-size=512", "-cpu", "max")
VIRTUALIZATION = ("-accel", "kvm", "-cpu", "host")

# These name places of the host that the guest does not have.
NOT_FOR_THE_GUEST = {
    "XDG_RUNTIME_DIR",
    "DBUS_SESSION_BUS_ADDRESS",
    "DISPLAY",
    "WAYLAND_DISPLAY",
    "SSH_AUTH_SOCK",
    "_",
}
KILL_WITH_PARENT = 1  # PR_SET_PDEATHSIG
LIBC = ctypes.CDLL(None)  # loaded here, because a forked child must not load anything before `exec`


class GuestError(RuntimeError):
    """The guest did not boot, or it went away before the command ended."""


@dataclass(frozen=True)
class Request:
    """What shall run in the guest, and what it shall find there."""

    command: Sequence[str]
    folder: Path
    writable: Sequence[Path] = ()
    channels: Sequence[str] = ("vcan0",)
    controllers: bool = False
    forward: Sequence[tuple[int, int]] = ()
    cpus: int = 2
    memory: str = "2G"
    verbose: bool = False


def interface_script(request: Request) -> str:
    """What session.sh runs, up to the first line that fails, to bring the requested interfaces up."""
    lines: list[str] = []
    for name in map(shlex.quote, request.channels):
        lines += [f"ip link add {name} type vcan", f"ip link set {name} up"]
    for name in CONTROLLERS if request.controllers else ():
        # restart-ms is for tests of the driver; what a robot should have stands in deploy/can/README.md.
        lines.append(f"ip link set {name} type can bitrate {BITRATE} restart-ms 100")
        lines.append(f"ip link set {name} txqueuelen {CONTROLLER_QUEUE} up")
    if request.forward:
        lines += ["ip address add 10.0.2.15/24 dev eth0", "ip link set eth0 up"]
    return "".join(f"{line}\n" for line in lines)


def command_script(request: Request, environment: Mapping[str, str]) -> str:
    """What the guest's shell runs: the host's environment and folder, then the command."""
    variables = {name: text for name, text in environment.items() if name not in NOT_FOR_THE_GUEST}
    # /tmp shows the host's files; a clean folder is safe from programs that clean up there.
    variables |= {"SNAKESIM_VCAN": "guest", "TMPDIR": "/run/snakesim/tmp"}
    exports = (
        f"export {name}={shlex.quote(text)}\n"
        for name, text in variables.items()
        if re.fullmatch(r"[A-Za-z_]\w*", name)
    )
    return f"{''.join(exports)}cd {shlex.quote(str(request.folder))} || exit 1\nexec {shlex.join(request.command)}\n"


def first_files(request: Request, environment: Mapping[str, str]) -> bytes:
    """The part of the guest's first file system that belongs to this run."""
    shares = "".join(f"{path}\n" for path in request.writable)
    return b"".join(
        (
            cpio.folder("run.d"),
            cpio.file("init", (SCRIPTS / "init.sh").read_bytes(), 0o755),
            cpio.file("run.d/session.sh", (SCRIPTS / "session.sh").read_bytes()),
            cpio.file("run.d/interfaces.sh", interface_script(request).encode()),
            cpio.file(
                "run.d/command.sh",
                command_script(request, environment).encode("utf-8", "surrogateescape"),
            ),
            cpio.file("run.d/shares", shares.encode("utf-8", "surrogateescape")),
            cpio.end(),
        )
    )


def qemu_arguments(
    request: Request, kernel: Kernel, kvm: bool, initramfs: str, ports: Mapping[str, int]
) -> list[str]:
    """QEMU's command line. `ports`: the number of an open socket for each of PORTS."""
    modules = [*BOOT_MODULES, *CAN_MODULES, *INPUT_MODULES]
    shares = ["-fsdev", "local,id=root,path=/,security_model=none,readonly=on,multidevs=remap"]
    shares += ["-device", "virtio-9p-pci,fsdev=root,mount_tag=root"]
    for number, path in enumerate(request.writable):
        escaped = str(path).replace(",", ",,")
        shares += [
            "-fsdev",
            f"local,id=share{number},path={escaped},security_model=none,multidevs=remap",
        ]
        shares += ["-device", f"virtio-9p-pci,fsdev=share{number},mount_tag=share{number}"]
    talk = ["-device", "virtio-serial-pci"]
    for name, number in ports.items():
        talk += ["-chardev", f"socket,id={name},fd={number}"]
        talk += (
            ["-serial", "chardev:console"]
            if name == "console"
            else ["-device", f"virtserialport,chardev={name},name={name}"]
        )
    network = []
    if request.forward:
        modules += NETWORK_MODULES
        rules = "".join(
            f",hostfwd=tcp:127.0.0.1:{outer}-:{inner}" for outer, inner in request.forward
        )
        network = [
            "-netdev",
            f"user,id=net,restrict=on{rules}",
            "-device",
            "virtio-net-pci,netdev=net,romfile=",
        ]
    controllers = []
    if request.controllers:
        modules += CONTROLLER_MODULES
        controllers = [
            "-object",
            "can-bus,id=canbus0",
            *("-device", "kvaser_pci,canbus=canbus0") * len(CONTROLLERS),
        ]
    options = f"{KERNEL_OPTIONS} snakesim_modules={','.join(load_order(modules, kernel))}"
    return [
        need_tool("qemu-system-x86_64"),
        *("-nodefaults", "-no-user-config", "-no-reboot", "-display", "none", "-machine", "q35"),
        *(VIRTUALIZATION if kvm else EMULATION),
        *("-smp", str(request.cpus), "-m", request.memory),
        *("-kernel", str(kernel.image), "-initrd", initramfs, "-append", options),
        *shares,
        *talk,
        *network,
        *controllers,
    ]


class Guest:
    """One running guest, until it is closed."""

    def __init__(self, request: Request, kernel: Kernel, kvm: bool) -> None:
        self._request = request
        self._console = b""
        self._control = b""
        self._passed = {"out": 0, "err": 0}
        self._ready = False
        self._ended: tuple[int, dict[str, int]] | None = None
        self._signals = 0
        self._held = ExitStack()
        self._selector = self._held.enter_context(selectors.DefaultSelector())
        with ExitStack() as handed_over:
            ours, theirs = {}, {}
            for name in PORTS:
                our_end, their_end = socket.socketpair()
                ours[name] = self._held.enter_context(our_end)
                theirs[name] = handed_over.enter_context(their_end).fileno()
                self._selector.register(our_end, selectors.EVENT_READ, name)
            self._control_port = ours["control"]
            initramfs = os.memfd_create("initramfs")  # the environment in it is private
            handed_over.callback(os.close, initramfs)
            with os.fdopen(os.dup(initramfs), "wb") as file:
                file.write(kernel.initramfs.read_bytes() + first_files(request, os.environ))
            self._process = subprocess.Popen(
                qemu_arguments(request, kernel, kvm, f"/proc/self/fd/{initramfs}", theirs),
                stdin=subprocess.DEVNULL,
                stdout=theirs["console"],
                stderr=theirs["console"],
                pass_fds=(initramfs, *theirs.values()),
                start_new_session=True,  # Ctrl-C goes to us, and from us to the command
                preexec_fn=_dying_with(os.getpid()),
            )

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        self._held.close()

    def wait_until_ready(self, limit_s: float) -> None:
        """Return as soon as the command starts.

        Raises:
            GuestError: after `limit_s`, or when the guest gives up.
        """
        deadline = time.monotonic() + limit_s
        while not self._ready:
            if time.monotonic() > deadline:
                raise GuestError(
                    f"the guest did not boot within {limit_s:.0f} s{self._last_words()}"
                )
            self._pass_on(timeout_s=0.5)

    def run(self) -> int:
        """Pass the output on until the command has ended; its exit code."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._forward_signal)
        while self._ended is None:
            self._pass_on(timeout_s=None)
        code, promised = self._ended
        deadline = time.monotonic() + DRAIN_LIMIT_S
        while (
            any(self._passed[name] < promised[name] for name in promised)
            and time.monotonic() < deadline
        ):
            self._pass_on(timeout_s=0.5)
        return code

    def _forward_signal(self, number: int, _frame: FrameType | None) -> None:
        self._signals += 1
        if self._signals > 1:
            raise KeyboardInterrupt  # a second request ends the command at once
        self._control_port.sendall(signal.Signals(number).name.removeprefix("SIG").encode() + b"\n")

    def _pass_on(self, timeout_s: float | None) -> None:
        """Handle what has arrived from the guest."""
        handlers: dict[str, Callable[[bytes], None]] = {
            "control": self._obey,
            "console": self._note,
        }
        for key, _ in self._selector.select(timeout_s):
            port = key.fileobj
            assert isinstance(port, socket.socket)
            content = b""
            with suppress(ConnectionResetError):
                content = port.recv(65536)
            if content:
                handlers.get(key.data, lambda text, name=key.data: self._print(name, text))(content)
            elif key.data == "control":
                raise GuestError(f"the guest went away{self._last_words()}")
            else:
                self._selector.unregister(port)

    def _obey(self, content: bytes) -> None:
        *lines, self._control = (self._control + content).split(b"\n")
        for line in lines:
            match line.decode().split():
                case ["ready"]:
                    self._ready = True
                case ["exit", code, out, err]:
                    self._ended = int(code), {"out": int(out), "err": int(err)}
                case _:
                    raise GuestError(f"the guest printed {line!r}")

    def _note(self, content: bytes) -> None:
        self._console = (self._console + content)[-CONSOLE_TAIL:]
        if self._request.verbose:
            _write(sys.stderr.fileno(), content.replace(b"\r", b""))

    def _print(self, name: str, content: bytes) -> None:
        _write({"out": 1, "err": 2}[name], content)
        self._passed[name] += len(content)

    def _last_words(self) -> str:
        output = self._console.replace(b"\r", b"").decode(errors="replace").strip()
        return f". It printed:\n{output}" if output else "; it printed nothing"


def _write(descriptor: int, content: bytes) -> None:
    while content:
        content = content[os.write(descriptor, content) :]


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies, however it dies. A machine costs a whole core."""
    LIBC.prctl(KILL_WITH_PARENT, signal.SIGKILL, 0, 0, 0)


def _dying_with(parent: int) -> Callable[[], None]:
    """For the child to run before QEMU: the kernel kills it when `parent` dies, even of SIGKILL."""

    def before_exec() -> None:
        die_with_parent()
        if os.getppid() != parent:
            os._exit(1)

    return before_exec
