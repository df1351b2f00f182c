"""The guests of deploy/vm: which kind is used, and a real guest of user-mode Linux that runs commands."""

import os
import platform
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.vm import kernel, machine, with_vcan
from deploy.vm.machine import GuestKind, GuestRequest
from snakesim_testing.harness.processes import find_processes_with
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

ROOT = Path(with_vcan.__file__).parents[2]
GUEST_TIMEOUT_S = 120  # a guest boots in about two seconds on a quiet computer

needs_user_mode_linux = pytest.mark.skipif(
    platform.machine() != "x86_64" or shutil.which("apt-get") is None,
    reason="user-mode Linux comes from a package of Debian for x86-64",
)


def make_request(**offers: object) -> GuestRequest:
    """Return a request for a guest that offers these things to the command `true`."""
    return GuestRequest(command=["true"], folder=Path("/"), **offers)  # pyright: ignore[reportArgumentType]


@pytest.fixture
def kvm_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the computer look like one with a KVM device that does not work."""
    monkeypatch.setattr(os, "access", lambda *_: True)
    monkeypatch.setattr(with_vcan, "read_kvm_result", lambda: False)


@pytest.mark.usefixtures("kvm_result")
def test_guest_kind_without_kvm_is_user_mode_then_emulated() -> None:
    kinds = with_vcan.choose_guest_kinds(make_request(), requested=None)
    assert kinds[0] is GuestKind.USER_MODE
    assert set(kinds[1:]) == {GuestKind.EMULATED}


def test_guest_kind_with_untested_kvm_is_kvm_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: True)
    monkeypatch.setattr(with_vcan, "read_kvm_result", lambda: None)
    assert with_vcan.choose_guest_kinds(make_request(), requested=None)[0] is GuestKind.KVM


@pytest.mark.usefixtures("kvm_result")
@pytest.mark.parametrize(
    "offers",
    [{"controllers": True}, {"forward": [(17447, 7447)]}, {"input_devices": True}],
    ids=["controllers", "forwarded port", "input devices"],
)
def test_guest_kind_that_lacks_a_device_is_not_used(offers: dict[str, object]) -> None:
    request = make_request(**offers)
    assert GuestKind.USER_MODE not in with_vcan.choose_guest_kinds(request, requested=None)
    with raises_error(machine.GuestError):
        with_vcan.choose_guest_kinds(request, requested=GuestKind.USER_MODE)


def test_user_mode_command_names_ports_memory_and_modules() -> None:
    user_mode_kernel = kernel.Kernel(
        version="6.1um4",
        image=Path("/cache/linux.uml"),
        initramfs=Path("/cache/initramfs"),
        depends={name: [] for name in (*kernel.USER_MODE_BOOT_MODULES, *kernel.CAN_MODULES)},
        built_in=[],
    )
    ports = {name: number for number, name in enumerate(machine.PORTS, start=10)}
    words = machine.make_user_mode_command(
        make_request(memory="512M"), user_mode_kernel, "/proc/self/fd/9", ports, "/state"
    )
    assert "--kill-child" in words[: words.index("/cache/linux.uml")]
    assert "mem=512M" in words
    assert "con1=fd:10" in words
    assert "con3=fd:12" in words
    assert "snakesim_modules=overlay,can,can_raw,can_bcm,vcan,sch_tbf" in words


def run_in_user_mode_guest(script: str) -> subprocess.CompletedProcess[bytes]:
    """Run a shell script in a guest of user-mode Linux, and return its outputs and exit code."""
    return subprocess.run(
        [sys.executable, with_vcan.__file__, "--guest", "user-mode", "--", "sh", "-c", script],
        cwd=ROOT,
        capture_output=True,
        timeout=GUEST_TIMEOUT_S,
        check=False,
    )


@needs_user_mode_linux
def test_user_mode_guest_passes_outputs_and_exit_code_unchanged() -> None:
    completed = run_in_user_mode_guest(r"printf 'a\r\nb\003c\n'; echo wrong >&2; exit 7")
    assert completed.stdout == b"a\r\nb\x03c\n"
    assert completed.stderr == b"wrong\n"
    assert completed.returncode == 7


@needs_user_mode_linux
def test_user_mode_guest_writes_only_into_this_checkout(tmp_path: Path) -> None:
    inside = ROOT / "build" / f"guest-{os.getpid()}"
    inside.parent.mkdir(exist_ok=True)
    outside = tmp_path / "outside"
    script = f"ip link show vcan0 >&2 && echo {inside.name} > {inside} && touch {outside}"
    try:
        completed = run_in_user_mode_guest(script)
        assert completed.returncode == 0, completed.stderr
        assert inside.read_text() == f"{inside.name}\n"
    finally:
        inside.unlink(missing_ok=True)
    assert not outside.exists()


@needs_user_mode_linux
def test_user_mode_guest_ends_with_its_killed_starter() -> None:
    command = ["sh", "-c", "echo started; sleep 1000"]
    starter = subprocess.Popen(
        [sys.executable, with_vcan.__file__, "--guest", "user-mode", "--", *command],
        cwd=ROOT,
        stdout=subprocess.PIPE,
    )
    with starter:
        assert starter.stdout is not None
        assert starter.stdout.readline() == b"started\n"
        guest_pids = find_descendants(starter.pid)
        assert guest_pids
        starter.send_signal(signal.SIGKILL)
    wait_until(
        lambda: not guest_pids & {pid for pid, _ in find_processes_with("cmdline", "linux.uml")},
        "all processes of the guest have ended",
        5,
    )


def find_descendants(pid: int) -> set[int]:
    """Return the process ids of all children of a process, their children, and so on."""
    children = {
        int(child)
        for path in Path(f"/proc/{pid}/task").glob("*/children")
        for child in path.read_text().split()
    }
    return children.union(*(find_descendants(child) for child in children))
