#!/usr/bin/env python3
"""Runs a command where virtual CAN interfaces are up: here, or in a small virtual machine.

    python deploy/vm/with_vcan.py -- .venv/bin/python -m pytest tests/system/can

A kernel with CAN gets a network namespace of its own, in which nothing of the host is touched. Where the kernel has no
CAN, the command runs in a guest that has the host's files: this checkout may be written, any other change stays in the
guest. SNAKESIM_VCAN is set to it: native or guest. Needs Debian or Ubuntu on x86-64 for the guest.

Why not virtme-ng: 1.42 boots the same kernel without KVM, but wants its modules and kmod installed on the host. It does
not load Debian's virtio_console, so output and exit code of the command were lost ("cannot find script I/O ports"), and
a command that took 45 s here, mostly imports, took 177 s there.
"""

import argparse
import json
import os
import platform
import shlex
import socket
import subprocess
import sys
from contextlib import closing
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # so that `deploy.vm` means the same here and in the tests

from deploy.vm.kernel import Kernel, cache_folder, ready_kernel  # noqa: E402
from deploy.vm.machine import Guest, GuestError, Request, die_with_parent  # noqa: E402
from deploy.vm.packages import PreparationError, find_tool, need_tool  # noqa: E402

BOOT_LIMIT_S = {True: 30.0, False: 120.0}  # with KVM, without
PROBE_LIMIT_S = 20.0
ATTEMPTS = 2
INTERRUPTED, BROKEN_PIPE, CANNOT = 130, 141, 125


def main() -> int:
    """Choose the place and run the command there; its exit code, or 125 when it could not be started."""
    arguments = _parsed()
    die_with_parent()
    try:
        need_tool("ip")
        only_guest = arguments.guest or arguments.controllers or arguments.forward
        if not only_guest and (prefix := native_prefix(arguments.channels)) is not None:
            os.environ["SNAKESIM_VCAN"] = "native"
            os.execvp((*prefix, *arguments.command)[0], [*prefix, *arguments.command])
        return run_in_guest(arguments)
    except (PreparationError, GuestError) as error:
        print(f"with_vcan: {error}", file=sys.stderr)
        return CANNOT
    except FileNotFoundError as error:
        print(f"with_vcan: there is no {error.filename}", file=sys.stderr)
        return CANNOT
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        return BROKEN_PIPE


def native_prefix(channels: list[str]) -> list[str] | None:
    """What to put before the command so that it finds the channels on this kernel; None if that cannot be."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return None
    present = {name for _, name in socket.if_nameindex()}
    if present.issuperset(channels):
        return []
    enter = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--map-root-user"]
    ip = shlex.quote(find_tool("ip") or "ip")
    bring_up = " && ".join(
        f"{ip} link add {name} type vcan && {ip} link set {name} up"
        for name in map(shlex.quote, channels)
    )
    prefix = [*enter, "sh", "-c", f'{ip} link set lo up && {bring_up} && exec "$@"', "sh"]
    tried = subprocess.run(
        [*prefix, "true"], stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    return prefix if tried.returncode == 0 else None


def run_in_guest(arguments: argparse.Namespace) -> int:
    """Boot a guest and run the command in it; a boot that fails is tried once more."""
    if platform.machine() != "x86_64":
        raise PreparationError(
            f"this kernel has no CAN, and there is no guest for {platform.machine()}, only for x86-64"
        )
    need_tool("qemu-system-x86_64")
    kernel = ready_kernel()
    request = Request(
        command=arguments.command,
        folder=Path.cwd(),
        writable=[ROOT, *(path.resolve(strict=True) for path in arguments.rwdir)],
        channels=arguments.channels,
        controllers=arguments.controllers,
        forward=arguments.forward,
        cpus=arguments.cpus,
        memory=arguments.memory,
        verbose=arguments.verbose,
    )
    kvm = kvm_works(kernel)
    for attempt in range(1, ATTEMPTS + 1):
        with closing(Guest(request, kernel, kvm)) as guest:
            try:
                guest.wait_until_ready(BOOT_LIMIT_S[kvm])
            except GuestError as error:
                if attempt == ATTEMPTS:
                    raise
                print(f"with_vcan: {error}\nwith_vcan: trying once more", file=sys.stderr)
                kvm = False  # in case that was it
                continue
            return guest.run()
    raise AssertionError("the last attempt returns or raises")


def kvm_works(kernel: Kernel) -> bool:
    """Whether a guest boots with KVM, tried once for each start of the machine: a KVM that is there may hang."""
    if not os.access("/dev/kvm", os.R_OK | os.W_OK):
        return False
    answers = cache_folder() / "kvm.json"
    this_start = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    known = json.loads(answers.read_text()) if answers.exists() else {}
    if this_start not in known:
        try:
            nothing = Request(command=["true"], folder=Path("/"), channels=[])
            with closing(Guest(nothing, kernel, kvm=True)) as guest:
                guest.wait_until_ready(PROBE_LIMIT_S)
            works = True
        except GuestError:
            works = False
        known = {this_start: works}
        answers.write_text(json.dumps(known))
    return known[this_start]


def _parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--channels", type=names, default=["vcan0"], help="default: vcan0; or vcan0,vcan1,..."
    )
    parser.add_argument(
        "--guest", action="store_true", help="use a guest even if this kernel has CAN"
    )
    parser.add_argument(
        "--verbose", action="store_true", help="show the messages of the guest's kernel"
    )
    guest = parser.add_argument_group("in the guest only")
    guest.add_argument(
        "--controllers",
        action="store_true",
        help="two emulated controllers, can0 and can1, on one bus",
    )
    guest.add_argument(
        "--forward", type=ports, action="append", default=[], metavar="HOSTPORT:GUESTPORT"
    )
    guest.add_argument(
        "--rwdir",
        type=Path,
        action="append",
        default=[],
        help="one more folder that may be written",
    )
    guest.add_argument("--cpus", type=int, default=2, help="default: 2")
    guest.add_argument("--memory", default="2G", help="default: 2G")
    parser.usage = "with_vcan.py [options] -- COMMAND ..."
    # Divided here, because a command may have a `--` of its own.
    words = sys.argv[1:]
    divided = words.index("--") if "--" in words else len(words)
    arguments = parser.parse_args(words[:divided])
    arguments.command = words[divided + 1 :]
    if not arguments.command:
        parser.error("there is no command; it comes after --")
    return arguments


def names(text: str) -> list[str]:
    """Interface names, as in `vcan0,vcan1`."""
    names = text.split(",")
    if not all(name.isalnum() and len(name) <= 15 for name in names):
        raise argparse.ArgumentTypeError(
            f"{text!r}: interface names of up to 15 letters and digits, with commas between"
        )
    return names


def ports(text: str) -> tuple[int, int]:
    """The host's and the guest's port, as in `17447:7447`."""
    outer, _, inner = text.partition(":")
    if not (
        outer.isdigit() and inner.isdigit() and 0 < int(outer) < 65536 and 0 < int(inner) < 65536
    ):
        raise argparse.ArgumentTypeError(f"{text!r}: two ports of 1 to 65535, as in 17447:7447")
    return int(outer), int(inner)


if __name__ == "__main__":
    sys.exit(main())
