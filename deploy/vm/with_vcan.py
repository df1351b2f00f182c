#!/usr/bin/env python3
"""Runs a command with virtual CAN interfaces, on this kernel or on a second one.

    python deploy/vm/with_vcan.py -- .venv/bin/python -m pytest tests/system/can

If this kernel has CAN, the command runs in a separate network namespace. Otherwise it runs in a guest: a virtual
machine with KVM, user-mode Linux, or a virtual machine with an emulated processor. The first of them that can do what
is requested, and that boots, is used. The guest has the files of the host. It may write this checkout; other changes
stay in the guest. The variable SNAKESIM_VCAN is set to `native` or `guest`. The guest needs Debian or Ubuntu on x86-64.

virtme-ng 1.42 is not used. It boots the same kernel without KVM, but needs its modules and kmod on the host. It does
not load Debian's virtio_console, so output and exit code of the command were lost ("cannot find script I/O ports"). A
command that took 45 s here, mostly imports, took 177 s there.
"""

import argparse
import json
import os
import platform
import re
import shlex
import socket
import subprocess
import sys
from contextlib import closing
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # so that `deploy.vm` is the same package here and in the tests

from deploy.vm.kernel import (  # noqa: E402
    Kernel,
    find_cache_folder,
    prepare_kernel,
    prepare_user_mode_kernel,
)
from deploy.vm.machine import (  # noqa: E402
    Guest,
    GuestError,
    GuestKind,
    GuestRequest,
    set_parent_death_signal,
)
from deploy.vm.packages import PreparationError, find_tool, require_tool  # noqa: E402

BOOT_TIMEOUTS_S = {GuestKind.KVM: 30.0, GuestKind.USER_MODE: 60.0, GuestKind.EMULATED: 120.0}
KVM_TEST_TIMEOUT_S = 20.0
MAX_PORT = 65535
ANY_KIND = "any"

# Exit codes, as shells and env(1) have them.
CANNOT_START = 125
INTERRUPTED = 130
BROKEN_PIPE = 141


def main() -> int:
    """Run the command on this kernel or in a guest, and return its exit code.

    Returns:
        The exit code of the command, or CANNOT_START if it could not be started.
    """
    arguments = _parse_arguments()
    set_parent_death_signal()
    try:
        require_tool("ip")
        needs_guest = bool(
            arguments.guest
            or arguments.controllers
            or arguments.forward
            or (arguments.joystick and not os.access("/dev/uinput", os.W_OK))
        )
        prefix = None if needs_guest else make_native_prefix(arguments.channels)
        if prefix is None:
            return run_in_guest(arguments)
        os.environ["SNAKESIM_VCAN"] = "native"
        command = [*prefix, *arguments.command]
        os.execvp(command[0], command)
    except (PreparationError, GuestError) as error:
        print(f"with_vcan: {error}", file=sys.stderr)
        return CANNOT_START
    except FileNotFoundError as error:
        print(f"with_vcan: {error.filename} does not exist", file=sys.stderr)
        return CANNOT_START
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        return BROKEN_PIPE


def make_native_prefix(channels: list[str]) -> list[str] | None:
    """Return the command prefix that runs a command with these interfaces on this kernel.

    Args:
        channels: Names of the interfaces.

    Returns:
        The prefix, which is empty if the interfaces exist. None if this kernel cannot have them.
    """
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return None
    present = {name for _, name in socket.if_nameindex()}
    if present.issuperset(channels):
        return []
    enter_namespace = ["unshare", "--net"]
    if os.geteuid() != 0:
        enter_namespace.append("--map-root-user")
    ip = shlex.quote(find_tool("ip") or "ip")
    create_interfaces = " && ".join(
        f"{ip} link add {name} type vcan && {ip} link set {name} up"
        for name in map(shlex.quote, channels)
    )
    prefix = [
        *enter_namespace,
        "sh",
        "-c",
        f'{ip} link set lo up && {create_interfaces} && exec "$@"',
        "sh",
    ]
    attempt = subprocess.run(
        [*prefix, "true"], stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    return prefix if attempt.returncode == 0 else None


def run_in_guest(arguments: argparse.Namespace) -> int:
    """Boot a guest, run the command in it, and return its exit code.

    If a guest cannot be prepared or does not boot, the next kind of guest is used.
    """
    if platform.machine() != "x86_64":
        raise PreparationError(
            f"this kernel has no CAN, and a guest needs x86-64, but this is {platform.machine()}"
        )
    request = GuestRequest(
        command=arguments.command,
        folder=Path.cwd(),
        writable=[ROOT, *(path.resolve(strict=True) for path in arguments.rwdir)],
        channels=arguments.channels,
        controllers=arguments.controllers,
        input_devices=arguments.joystick,
        forward=arguments.forward,
        cpus=arguments.cpus,
        memory=arguments.memory,
        verbose=arguments.verbose,
    )
    requested_kind = None if arguments.guest in (None, ANY_KIND) else GuestKind(arguments.guest)
    *kinds, last_kind = choose_guest_kinds(request, requested_kind)
    for kind in kinds:
        try:
            guest = boot_guest(request, kind)
        except (PreparationError, GuestError) as error:
            print(f"with_vcan: {error}\nwith_vcan: trying another guest", file=sys.stderr)
        else:
            break
    else:
        guest = boot_guest(request, last_kind)
    with closing(guest):
        return guest.run()


def choose_guest_kinds(request: GuestRequest, requested: GuestKind | None) -> list[GuestKind]:
    """Return the kinds of guest to try, in this order.

    Args:
        request: What the guest must offer.
        requested: The only kind to try; None for any.

    Raises:
        GuestError: The requested kind does not offer what the request needs.
    """
    needs_machine = bool(request.controllers or request.forward or request.input_devices)
    match requested:
        case GuestKind.USER_MODE if needs_machine:
            raise GuestError(
                "user-mode Linux has no CAN controllers, no forwarded ports and no input devices. "
                "Use --guest kvm or --guest emulated"
            )
        case GuestKind():
            return [requested]
        case None:
            kinds: list[GuestKind] = []
            if os.access("/dev/kvm", os.R_OK | os.W_OK) and read_kvm_result() is not False:
                kinds.append(GuestKind.KVM)
            if not needs_machine:
                kinds.append(GuestKind.USER_MODE)
            # Twice: on a busy computer, the boot of an emulated processor sometimes fails at its late timer.
            return [*kinds, GuestKind.EMULATED, GuestKind.EMULATED]


def boot_guest(request: GuestRequest, kind: GuestKind) -> Guest:
    """Prepare the kernel, start a guest, and wait until it runs the command.

    Raises:
        PreparationError: A tool or package is missing, and cannot be installed.
        GuestError: The guest did not boot.
    """
    match kind:
        case GuestKind.USER_MODE:
            kernel = prepare_user_mode_kernel()
        case GuestKind.KVM | GuestKind.EMULATED:
            require_tool("qemu-system-x86_64")
            kernel = prepare_kernel()
    if kind is GuestKind.KVM and not check_kvm(kernel):
        raise GuestError("a virtual machine with KVM does not boot on this computer")
    guest = Guest(request, kernel, kind)
    try:
        guest.wait_until_ready(BOOT_TIMEOUTS_S[kind])
    except GuestError:
        guest.close()
        raise
    return guest


def check_kvm(kernel: Kernel) -> bool:
    """Return whether a guest boots with KVM. A KVM that exists may hang.

    The test runs once for each start of the computer. Its result is kept in the cache.
    """
    works = read_kvm_result()
    if works is None:
        request = GuestRequest(command=["true"], folder=Path("/"), channels=[])
        try:
            with closing(Guest(request, kernel, GuestKind.KVM)) as guest:
                guest.wait_until_ready(KVM_TEST_TIMEOUT_S)
            works = True
        except GuestError:
            works = False
        _find_kvm_results().write_text(json.dumps({_read_boot_id(): works}))
    return works


def read_kvm_result() -> bool | None:
    """Return the result of the last test of KVM; None if there was none since this computer started."""
    path = _find_kvm_results()
    results: dict[str, bool] = json.loads(path.read_text()) if path.exists() else {}
    return results.get(_read_boot_id())


def _find_kvm_results() -> Path:
    return find_cache_folder() / "kvm.json"


def _read_boot_id() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text().strip()


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--channels",
        type=parse_interface_names,
        default=["vcan0"],
        help="names of the interfaces, such as vcan0,vcan1 (vcan0)",
    )
    parser.add_argument(
        "--guest",
        nargs="?",
        const=ANY_KIND,
        choices=[ANY_KIND, *(kind.value for kind in GuestKind)],
        help="use a guest even if this kernel has CAN, of this kind (any)",
    )
    parser.add_argument(
        "--verbose", action="store_true", help="show the messages of the guest's kernel"
    )
    guest = parser.add_argument_group("in the guest only")
    guest.add_argument(
        "--controllers",
        action="store_true",
        help="emulate two CAN controllers on one bus, can0 and can1",
    )
    guest.add_argument(
        "--joystick",
        action="store_true",
        help="let programs create input devices such as joysticks (uinput)",
    )
    guest.add_argument(
        "--forward",
        type=parse_ports,
        action="append",
        default=[],
        metavar="HOSTPORT:GUESTPORT",
        help="forward a TCP port of this computer to the guest; may be repeated",
    )
    guest.add_argument(
        "--rwdir",
        type=Path,
        action="append",
        default=[],
        help="folder that the guest may write; may be repeated",
    )
    guest.add_argument(
        "--cpus", type=int, default=2, help="number of processors (2); user-mode Linux has one"
    )
    guest.add_argument(
        "--memory", type=parse_memory, default="2G", help="size of the memory, such as 512M (2G)"
    )
    parser.usage = "with_vcan.py [options] -- COMMAND ..."
    # The first `--` separates options and command. The command may contain another one.
    words = sys.argv[1:]
    separator = words.index("--") if "--" in words else len(words)
    arguments = parser.parse_args(words[:separator])
    arguments.command = words[separator + 1 :]
    if not arguments.command:
        parser.error("the command is missing; it comes after --")
    return arguments


def parse_interface_names(text: str) -> list[str]:
    """Return the names in a list of interfaces such as `vcan0,vcan1`."""
    names = text.split(",")
    if not all(name.isalnum() and len(name) <= 15 for name in names):
        raise argparse.ArgumentTypeError(
            f"{text!r}: interface names of up to 15 letters and digits, with commas between"
        )
    return names


def parse_memory(text: str) -> str:
    """Return a size of the memory such as `2G` or `512M`, if it is valid."""
    if not re.fullmatch(r"[1-9]\d*[MG]", text):
        raise argparse.ArgumentTypeError(f"{text!r}: a size such as 512M or 2G")
    return text


def parse_ports(text: str) -> tuple[int, int]:
    """Return the port of the host and that of the guest in a text such as `17447:7447`."""
    host_port, _, guest_port = text.partition(":")
    if not (_is_port(host_port) and _is_port(guest_port)):
        raise argparse.ArgumentTypeError(f"{text!r}: two ports of 1 to 65535, as in 17447:7447")
    return int(host_port), int(guest_port)


def _is_port(text: str) -> bool:
    return text.isdigit() and 0 < int(text) <= MAX_PORT


if __name__ == "__main__":
    sys.exit(main())
