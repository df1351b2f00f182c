"""Boots a second Linux (the guest), runs one command in it, and prints the output of the command.

The guest is a virtual machine of QEMU, or user-mode Linux: a kernel that runs as a program. The guest's root is the
file system of the host, read-only. Files that the guest writes stay in its memory, except in folders that are shared
writable. The guest caches files: it may miss a change that the host makes while it runs. The guest reaches no network.
The host reaches a virtual machine through forwarded ports.
"""

import ctypes
import os
import re
import selectors
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import FrameType

from deploy.vm import cpio
from deploy.vm.kernel import (
    BOOT_MODULES,
    CAN_MODULES,
    CONTROLLER_MODULES,
    INPUT_MODULES,
    NETWORK_MODULES,
    USER_MODE_BOOT_MODULES,
    Kernel,
    order_modules,
)
from deploy.vm.packages import require_tool

SCRIPTS = Path(__file__).parent
PORTS = ("out", "err", "control", "console")  # serial ports between guest and host
CONSOLE_TAIL_BYTES = 4000
DRAIN_TIMEOUT_S = 10.0
OUTPUT_DESCRIPTORS = {"out": 1, "err": 2}
CONTROLLERS = ("can0", "can1")  # emulated CAN controllers
BITRATE = 1_000_000  # bit/s
CONTROLLER_QUEUE_LENGTH = 1000  # frames

# mitigations=off and nokaslr: a test's guest needs no defense against attacks, and system calls take half the time.
# no_timer_check: on a busy host, the emulated timer is late, and the kernel would panic at its check during the boot.
KERNEL_OPTIONS = "console=ttyS0 quiet loglevel=3 panic=-1 no_timer_check mitigations=off nokaslr cryptomgr.notests"
USER_MODE_KERNEL_OPTIONS = ("quiet", "loglevel=3")
SHARED_MEMORY = Path("/dev/shm")
BYTES_BY_UNIT = {"M": 2**20, "G": 2**30}
EMULATION = ("-accel", "tcg,thread=multi,tb-size=512", "-cpu", "max")
VIRTUALIZATION = ("-accel", "kvm", "-cpu", "host")

# These variables name sockets and sessions of the host, which the guest does not have.
HOST_ONLY_VARIABLES = {
    "XDG_RUNTIME_DIR",
    "DBUS_SESSION_BUS_ADDRESS",
    "DISPLAY",
    "WAYLAND_DISPLAY",
    "SSH_AUTH_SOCK",
    "_",
}
PR_SET_PDEATHSIG = 1  # from <linux/prctl.h>
LIBC = ctypes.CDLL(None)  # loaded here, because a forked child must not load anything before `exec`


class GuestKind(Enum):
    """How a guest runs. The values are those of the option `--guest`."""

    KVM = "kvm"  # a virtual machine on the processor itself
    USER_MODE = "user-mode"  # user-mode Linux: one processor, and no devices but CAN
    EMULATED = "emulated"  # a virtual machine whose processor is emulated, about ten times slower


class GuestError(RuntimeError):
    """Raised if the guest did not boot, or ended before the command did."""


@dataclass(frozen=True)
class GuestRequest:
    """A command for the guest, and what the guest offers to it."""

    command: Sequence[str]
    folder: Path
    writable: Sequence[Path] = ()  # folders of the host that the guest may write
    channels: Sequence[str] = ("vcan0",)  # virtual CAN interfaces
    controllers: bool = False  # whether there are two emulated CAN controllers
    input_devices: bool = False  # whether programs may create input devices (uinput)
    forward: Sequence[tuple[int, int]] = ()  # (port of the host, port of the guest)
    cpus: int = 2  # user-mode Linux always has one
    memory: str = "2G"
    verbose: bool = False  # whether to print the messages of the guest's kernel


def make_interface_script(request: GuestRequest) -> str:
    """Return the script that sets up the requested interfaces. session.sh runs it until a line fails."""
    lines: list[str] = []
    for name in map(shlex.quote, request.channels):
        lines += [f"ip link add {name} type vcan", f"ip link set {name} up"]
    if request.controllers:
        for name in CONTROLLERS:
            # restart-ms is for tests of the driver; deploy/can/README.md has the values for a robot.
            lines.append(f"ip link set {name} type can bitrate {BITRATE} restart-ms 100")
            lines.append(f"ip link set {name} txqueuelen {CONTROLLER_QUEUE_LENGTH} up")
    if request.forward:
        lines += ["ip address add 10.0.2.15/24 dev eth0", "ip link set eth0 up"]
    return "".join(f"{line}\n" for line in lines)


def make_command_script(request: GuestRequest, environment: Mapping[str, str]) -> str:
    """Return the script that runs the command with the environment and in the folder of the host."""
    variables = {
        name: value for name, value in environment.items() if name not in HOST_ONLY_VARIABLES
    }
    # /tmp contains the files of the host. An own folder keeps programs from removing them.
    variables |= {"SNAKESIM_VCAN": "guest", "TMPDIR": "/run/snakesim/tmp"}
    exports = (
        f"export {name}={shlex.quote(value)}\n"
        for name, value in variables.items()
        if re.fullmatch(r"[A-Za-z_]\w*", name)
    )
    return f"{''.join(exports)}cd {shlex.quote(str(request.folder))} || exit 1\nexec {shlex.join(request.command)}\n"


def make_run_archive(request: GuestRequest, environment: Mapping[str, str]) -> bytes:
    """Return the part of the guest's first file system that belongs to this run, as a cpio archive."""
    shares = "".join(f"{path}\n" for path in request.writable)
    return b"".join(
        (
            cpio.make_folder_entry("run.d"),
            cpio.make_file_entry("init", (SCRIPTS / "init.sh").read_bytes(), 0o755),
            cpio.make_file_entry("run.d/session.sh", (SCRIPTS / "session.sh").read_bytes()),
            cpio.make_file_entry("run.d/interfaces.sh", make_interface_script(request).encode()),
            cpio.make_file_entry(
                "run.d/command.sh",
                make_command_script(request, environment).encode("utf-8", "surrogateescape"),
            ),
            cpio.make_file_entry("run.d/shares", shares.encode("utf-8", "surrogateescape")),
            cpio.make_end_entry(),
        )
    )


def make_qemu_command(
    request: GuestRequest, kernel: Kernel, kvm: bool, initramfs: str, ports: Mapping[str, int]
) -> list[str]:
    """Return the command line of QEMU.

    Args:
        request: The command and the guest that it needs.
        kernel: The kernel to boot.
        kvm: Whether to use KVM; otherwise QEMU emulates the processor.
        initramfs: Path of the guest's first file system.
        ports: File descriptor of an open socket for each of PORTS.
    """
    modules = [*BOOT_MODULES, *CAN_MODULES]
    if request.input_devices:
        modules += INPUT_MODULES
    shares = ["-fsdev", "local,id=root,path=/,security_model=none,readonly=on,multidevs=remap"]
    shares += ["-device", "virtio-9p-pci,fsdev=root,mount_tag=root"]
    for number, path in enumerate(request.writable):
        escaped = str(path).replace(",", ",,")
        shares += [
            "-fsdev",
            f"local,id=share{number},path={escaped},security_model=none,multidevs=remap",
        ]
        shares += ["-device", f"virtio-9p-pci,fsdev=share{number},mount_tag=share{number}"]
    serial_ports = ["-device", "virtio-serial-pci"]
    for name, descriptor in ports.items():
        serial_ports += ["-chardev", f"socket,id={name},fd={descriptor}"]
        if name == "console":
            serial_ports += ["-serial", "chardev:console"]
        else:
            serial_ports += ["-device", f"virtserialport,chardev={name},name={name}"]
    network = []
    if request.forward:
        modules += NETWORK_MODULES
        rules = "".join(
            f",hostfwd=tcp:127.0.0.1:{host_port}-:{guest_port}"
            for host_port, guest_port in request.forward
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
    options = f"{KERNEL_OPTIONS} snakesim_modules={','.join(order_modules(modules, kernel))}"
    return [
        require_tool("qemu-system-x86_64"),
        *("-nodefaults", "-no-user-config", "-no-reboot", "-display", "none", "-machine", "q35"),
        *(VIRTUALIZATION if kvm else EMULATION),
        *("-smp", str(request.cpus), "-m", request.memory),
        *("-kernel", str(kernel.image), "-initrd", initramfs, "-append", options),
        *shares,
        *serial_ports,
        *network,
        *controllers,
    ]


def make_user_mode_command(
    request: GuestRequest,
    kernel: Kernel,
    initramfs: str,
    ports: Mapping[str, int],
    state_folder: str,
) -> list[str]:
    """Return the command line of user-mode Linux, in a process namespace of its own.

    The processes of the guest are processes of the host. The namespace ends all of them together with the kernel that
    controls them. Without it, they would go on as programs of the host if that kernel was killed.

    Args:
        request: The command and the guest that it needs.
        kernel: User-mode Linux.
        initramfs: Path of the guest's first file system.
        ports: File descriptor of an open socket for each of PORTS.
        state_folder: Folder in which the kernel keeps its process id and a socket.
    """
    modules = order_modules([*USER_MODE_BOOT_MODULES, *CAN_MODULES], kernel)
    as_root = [] if os.geteuid() == 0 else ["--user", "--map-root-user"]
    return [
        *(require_tool("unshare"), *as_root, "--pid", "--fork", "--kill-child"),
        str(kernel.image),
        *(f"mem={request.memory}", f"initrd={initramfs}", f"uml_dir={state_folder}"),
        *USER_MODE_KERNEL_OPTIONS,
        *("con=null", f"con0=null,fd:{ports['console']}"),
        *(f"con1=fd:{ports['out']}", f"con2=fd:{ports['err']}", f"con3=fd:{ports['control']}"),
        *("snakesim_files=hostfs", f"snakesim_modules={','.join(modules)}"),
    ]


def find_memory_folder(request: GuestRequest) -> str:
    """Return the folder for the file that is the memory of user-mode Linux.

    It is in memory itself, if there is room. Some containers allow very small files there.
    """
    needed_bytes = parse_memory_size(request.memory)
    space = shutil.disk_usage(SHARED_MEMORY)
    return str(SHARED_MEMORY) if space.free >= needed_bytes else tempfile.gettempdir()


def parse_memory_size(text: str) -> int:
    """Return the bytes in a size such as `2G` or `512M`."""
    return int(text[:-1]) * BYTES_BY_UNIT[text[-1]]


class Guest:
    """A running guest. `close` ends it."""

    def __init__(self, request: GuestRequest, kernel: Kernel, kind: GuestKind) -> None:
        """Start the guest. It boots in the background.

        Args:
            request: The command and the guest that it needs.
            kernel: The kernel to boot. It must fit the kind.
            kind: How the guest runs.
        """
        self._request = request
        self._console_tail = b""  # last output of the guest's kernel
        self._control_rest = b""  # begin of a line that has not arrived completely
        self._printed_bytes = {"out": 0, "err": 0}
        self._ready = False
        self._result: tuple[int, dict[str, int]] | None = None  # exit code, length of its outputs
        self._signal_count = 0
        self._resources = ExitStack()
        self._selector = self._resources.enter_context(selectors.DefaultSelector())
        with ExitStack() as inherited:
            host_ends: dict[str, socket.socket] = {}
            guest_descriptors: dict[str, int] = {}
            for name in PORTS:
                host_end, guest_end = socket.socketpair()
                host_ends[name] = self._resources.enter_context(host_end)
                guest_descriptors[name] = inherited.enter_context(guest_end).fileno()
                self._selector.register(host_end, selectors.EVENT_READ, name)
            self._control_port = host_ends["control"]
            # A file in memory, because it contains the environment, which other users must not read.
            initramfs = os.memfd_create("initramfs")
            inherited.callback(os.close, initramfs)
            with os.fdopen(os.dup(initramfs), "wb") as file:
                file.write(kernel.initramfs.read_bytes() + make_run_archive(request, os.environ))
            initramfs_path = f"/proc/self/fd/{initramfs}"
            environment = dict(os.environ)
            match kind:
                case GuestKind.USER_MODE:
                    folder = self._resources.enter_context(tempfile.TemporaryDirectory())
                    command = make_user_mode_command(
                        request, kernel, initramfs_path, guest_descriptors, folder
                    )
                    environment["TMPDIR"] = find_memory_folder(request)
                case GuestKind.KVM | GuestKind.EMULATED:
                    kvm = kind is GuestKind.KVM
                    command = make_qemu_command(
                        request, kernel, kvm, initramfs_path, guest_descriptors
                    )
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=guest_descriptors["console"],
                stderr=guest_descriptors["console"],
                pass_fds=(initramfs, *guest_descriptors.values()),
                start_new_session=True,  # this process gets Ctrl-C, and forwards it to the command
                preexec_fn=_make_child_setup(os.getpid()),
            )

    def close(self) -> None:
        """End the guest at once."""
        self._process.kill()
        self._process.wait()
        self._resources.close()

    def wait_until_ready(self, timeout_s: float) -> None:
        """Wait until the command starts.

        Raises:
            GuestError: The guest did not boot in time, or it ended.
        """
        deadline_s = time.monotonic() + timeout_s
        while not self._ready:
            if time.monotonic() > deadline_s:
                raise GuestError(
                    f"the guest did not boot within {timeout_s:.0f} s{self._describe_console()}"
                )
            self._handle_output(timeout_s=0.5)

    def run(self) -> int:
        """Print the output of the command until it has ended, and return its exit code.

        Signals that end a program are forwarded to the command.
        """
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._forward_signal)
        while self._result is None:
            self._handle_output(timeout_s=None)
        code, output_bytes = self._result
        deadline_s = time.monotonic() + DRAIN_TIMEOUT_S
        while not self._has_printed(output_bytes) and time.monotonic() < deadline_s:
            self._handle_output(timeout_s=0.5)
        return code

    def _has_printed(self, output_bytes: Mapping[str, int]) -> bool:
        """Return whether at least this many bytes of each output are printed."""
        return all(self._printed_bytes[name] >= count for name, count in output_bytes.items())

    def _forward_signal(self, number: int, _frame: FrameType | None) -> None:
        """Forward the first signal to the command. The second one ends the guest."""
        self._signal_count += 1
        if self._signal_count > 1:
            raise KeyboardInterrupt
        self._control_port.sendall(signal.Signals(number).name.removeprefix("SIG").encode() + b"\n")

    def _handle_output(self, timeout_s: float | None) -> None:
        """Read the ports of the guest, and process what has arrived."""
        for key, _ in self._selector.select(timeout_s):
            port = key.fileobj
            assert isinstance(port, socket.socket)
            content = b""
            with suppress(ConnectionResetError):
                content = port.recv(65536)
            if content:
                self._process_content(key.data, content)
            elif key.data == "control":
                raise GuestError(f"the guest has ended{self._describe_console()}")
            else:
                self._selector.unregister(port)

    def _process_content(self, port: str, content: bytes) -> None:
        """Process what has arrived on a port of the guest."""
        match port:
            case "control":
                self._process_control(content)
            case "console":
                self._process_console(content)
            case _:
                self._print_output(port, content)

    def _process_control(self, content: bytes) -> None:
        """Process the lines of session.sh: `ready`, and `exit` with the code and the length of both outputs."""
        *lines, self._control_rest = (self._control_rest + content).split(b"\n")
        for line in lines:
            match line.decode().split():
                case ["ready"]:
                    self._ready = True
                case ["exit", code, out, err]:
                    self._result = int(code), {"out": int(out), "err": int(err)}
                case _:
                    raise GuestError(f"the guest printed {line!r}")

    def _process_console(self, content: bytes) -> None:
        """Keep the last messages of the guest's kernel, and print them if requested."""
        self._console_tail = (self._console_tail + content)[-CONSOLE_TAIL_BYTES:]
        if self._request.verbose:
            _write(sys.stderr.fileno(), content.replace(b"\r", b""))

    def _print_output(self, name: str, content: bytes) -> None:
        """Print output of the command."""
        _write(OUTPUT_DESCRIPTORS[name], content)
        self._printed_bytes[name] += len(content)

    def _describe_console(self) -> str:
        """Return the last messages of the guest's kernel, as the end of an error message."""
        output = self._console_tail.replace(b"\r", b"").decode(errors="replace").strip()
        return f". It printed:\n{output}" if output else "; it printed nothing"


def _write(descriptor: int, content: bytes) -> None:
    """Write all of a content to a file descriptor."""
    while content:
        written_bytes = os.write(descriptor, content)
        content = content[written_bytes:]


def set_parent_death_signal() -> None:
    """Make the kernel kill this process when its parent ends, even by SIGKILL. A guest occupies a whole core."""
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _make_child_setup(parent_pid: int) -> Callable[[], None]:
    """Return a function that a child calls before it becomes the guest, so that it ends with its parent."""

    def before_exec() -> None:
        set_parent_death_signal()
        if os.getppid() != parent_pid:  # the parent has ended before the call above
            os._exit(1)

    return before_exec
