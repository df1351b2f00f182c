"""Tests of deploy/vm that need no virtual machine: its archive, kernel, scripts, and QEMU command."""

import argparse
import lzma
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from deploy.vm import cpio, kernel, machine, with_vcan
from deploy.vm.packages import PreparationError
from snakesim_testing.harness.processes import find_processes_with
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

KERNEL = kernel.Kernel(
    version="6.1-test",
    image=Path("/cache/vmlinux"),
    initramfs=Path("/cache/initramfs"),
    depends={
        **{name: [] for name in (*kernel.BOOT_MODULES, "can", "can_dev", "sja1000", "sch_tbf")},
        "can_raw": ["can"],
        "uinput": [],
        "evdev": [],
        "can_bcm": ["can"],
        "vcan": ["can_dev"],
        "kvaser_pci": ["sja1000", "can_dev"],
    },
    built_in=["virtio_net"],
)
REQUEST = machine.GuestRequest(
    command=["printf", "%s", "it's"], folder=Path("/a folder"), writable=[Path("/re,po")]
)


def test_archive_entry_of_any_length_is_aligned() -> None:
    for length in range(5):
        entry = cpio.make_file_entry("n" * length + "x", b"c" * length)
        assert len(entry) % 4 == 0
        # The size is the seventh of the eight-digit fields after the magic number.
        assert int(entry[54:62], 16) == length


def test_vm_modules_are_ordered_by_dependency_without_builtin_ones() -> None:
    order = kernel.order_modules(["can_raw", "virtio_net", "kvaser_pci", "vcan"], KERNEL)
    assert order == ["can", "can_raw", "sja1000", "can_dev", "kvaser_pci", "vcan"]


def test_vm_kernel_without_required_module_is_refused() -> None:
    with raises_error(PreparationError):
        kernel.order_modules(["flexcan"], KERNEL)


@pytest.mark.parametrize(
    ("section", "names"),
    [
        (b"license=GPL\0depends=can-dev,sja1000\0retpoline=Y\0", ["can_dev", "sja1000"]),
        (b"license=GPL\0depends=\0", []),
        (b"license=GPL\0", []),
    ],
)
def test_vm_module_dependencies_are_read_from_its_file(section: bytes, names: list[str]) -> None:
    assert kernel.find_dependencies(b"\x7fELF\0" + section) == names


def test_vm_module_name_has_no_dash_and_no_suffix() -> None:
    assert kernel.parse_module_name("kernel/net/can/can-raw.ko.xz") == "can_raw"


def make_bz_image(payload: bytes) -> bytes:
    """Return a kernel image as the boot protocol defines it, with a payload.

    A boot sector and four setup sectors precede the compressed kernel.
    """
    head = bytearray(5 * 512)
    head[0x1F1] = 4  # setup sectors
    struct.pack_into("<II", head, 0x248, 16, len(payload))
    return bytes(head) + bytes(16) + payload


def test_vm_kernel_image_yields_its_plain_kernel() -> None:
    plain = b"\x7fELF" + struct.pack("<III", 4, 8, 18) + b"Xen\0" + bytes(64)
    assert kernel.extract_plain_kernel(make_bz_image(lzma.compress(plain) + b"size")) == plain


def test_vm_kernel_without_pvh_entry_stays_packed() -> None:
    assert kernel.extract_plain_kernel(make_bz_image(lzma.compress(b"\x7fELF" + bytes(64)))) is None
    assert kernel.extract_plain_kernel(make_bz_image(b"\x1f\x8b gzip")) is None


def test_vm_command_keeps_arguments_folder_and_environment(tmp_path: Path) -> None:
    request = machine.GuestRequest(
        command=["sh", "-c", 'echo "$0 $GREETING $SNAKESIM_VCAN" > out', "it's"], folder=tmp_path
    )
    script = machine.make_command_script(
        request, {"GREETING": "two\nlines", "DISPLAY": ":0", "BASH_FUNC_x%%": "() { :; }"}
    )
    subprocess.run(["sh", "-c", script], check=True, timeout=30, env={"PATH": "/usr/bin:/bin"})
    assert (tmp_path / "out").read_text() == "it's two\nlines guest\n"
    assert "DISPLAY" not in script
    assert "BASH_FUNC" not in script


def test_vm_interface_script_configures_requested_interfaces() -> None:
    request = machine.GuestRequest(
        [], Path("/"), channels=["vcan0", "vcan1"], controllers=True, forward=[(17447, 7447)]
    )
    script = machine.make_interface_script(request)
    assert "ip link add vcan1 type vcan\nip link set vcan1 up\n" in script
    assert "ip link set can1 type can bitrate 1000000" in script
    assert "ip link set eth0 up" in script
    assert "can1 type can" not in machine.make_interface_script(REQUEST)


def make_qemu_line(
    request: machine.GuestRequest, monkeypatch: pytest.MonkeyPatch, kvm: bool = False
) -> str:
    """Return the QEMU command line for a request, as if all tools were installed."""
    monkeypatch.setattr(machine, "require_tool", str)
    ports = {name: number for number, name in enumerate(machine.PORTS, start=10)}
    return " ".join(machine.make_qemu_command(request, KERNEL, kvm, "/proc/self/fd/9", ports))


def test_vm_host_files_are_read_only_except_given_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    line = make_qemu_line(REQUEST, monkeypatch)
    assert "path=/,security_model=none,readonly=on" in line
    assert "id=share0,path=/re,,po,security_model=none,multidevs" in line
    assert "accel tcg" in line
    assert "accel kvm" in make_qemu_line(REQUEST, monkeypatch, kvm=True)


def test_vm_guest_has_network_only_for_forwarded_loopback_ports(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert "-netdev" not in make_qemu_line(REQUEST, monkeypatch)
    line = make_qemu_line(machine.GuestRequest([], Path("/"), forward=[(17447, 7447)]), monkeypatch)
    assert "restrict=on,hostfwd=tcp:127.0.0.1:17447-:7447" in line


def test_vm_can_controllers_share_one_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    line = make_qemu_line(machine.GuestRequest([], Path("/"), controllers=True), monkeypatch)
    assert line.count("kvaser_pci,canbus=canbus0") == 2
    assert line.index("sja1000,") < line.index("kvaser_pci ")
    assert "kvaser_pci" not in make_qemu_line(REQUEST, monkeypatch)


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        *((with_vcan.parse_ports, text) for text in ("", "17447", "0:7447", "17447:70000", "a:b")),
        *(
            (with_vcan.parse_interface_names, text)
            for text in ("", "vcan0,", "vcan0;reboot", "a-name-of-more-than-fifteen")
        ),
    ],
)
def test_vm_invalid_port_forward_and_channel_name_are_refused(
    parse: Callable[[str], object], text: str
) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        parse(text)


def test_vm_without_command_is_refused() -> None:
    completed = subprocess.run(
        [sys.executable, with_vcan.__file__, "--channels", "vcan0"],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert completed.returncode == 2
    assert "it comes after --" in completed.stderr


PROGRAM_WITHOUT_MACHINE = """
import os, sys, time
from deploy.vm import with_vcan
def wait_in_place_of_a_machine(_arguments):
    print(os.getpid(), flush=True)
    time.sleep(60)
with_vcan.run_in_guest = wait_in_place_of_a_machine
sys.argv = ["with_vcan", "--guest", "--", "true"]
with_vcan.main()
"""
PARENT_PROGRAM = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]])
time.sleep(60)
"""


def test_vm_command_dies_with_its_killed_parent() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT_PROGRAM, PROGRAM_WITHOUT_MACHINE],
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(machine.__file__).parents[2],
    )
    with parent:
        assert parent.stdout is not None
        child_pid = int(parent.stdout.readline())
        parent.kill()
    wait_until(
        lambda: child_pid not in dict(find_processes_with("cmdline", "with_vcan.main()")),
        "the command has ended",
        5,
    )
