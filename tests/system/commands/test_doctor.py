"""`snakesim doctor`: a verdict on everything, and what to type where something is missing."""

import fcntl
import json
import os
import socket
from pathlib import Path

import pytest

from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.cli import main
from snakesim_operator.this_computer.kernel import check_kernel
from snakesim_operator.this_computer.network_findings import check_ports, check_routers
from snakesim_testing.harness.endpoint import find_free_endpoint


def test_it_checks_everything_and_leaves_this_process_as_it_was(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = os.sched_getscheduler(0)
    assert main(["doctor", "--json", "--endpoint", find_free_endpoint()]) == 1, (
        "nobody answers there"
    )
    reported = json.loads(capsys.readouterr().out)
    assert {"Python", "OpenGL", "CAN", "disk", "kernel"} < {
        finding["what"] for finding in reported["findings"]
    }
    assert not reported["ok"]
    assert reported["findings"][-1]["state"] == "fail"
    for finding in reported["findings"]:
        assert finding["state"] in ("ok", "warn", "fail")
        assert finding["detail"]
        assert finding["state"] == "ok" or finding["fix"] or finding["what"] == "KVM"
    assert os.sched_getscheduler(0) == before


def test_doctor_endpoint_without_zenoh_fails_within_seconds() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        (finding,) = check_routers(RobotSelection(f"tcp/127.0.0.1:{mute.getsockname()[1]}"))
    assert finding.state == "fail"
    assert finding.fix


def test_the_default_port_is_free_or_has_a_user() -> None:
    (finding,) = check_ports()
    assert finding.what == "port 7447"
    assert finding.state in ("ok", "warn")


@pytest.mark.parametrize(
    ("files", "warned"),
    [
        ({"proc/version": "Linux version 6.12 SMP PREEMPT_DYNAMIC"}, ["kernel"]),
        ({"proc/version": "Linux version 6.12-rt SMP PREEMPT_RT"}, []),
        ({"sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave"}, ["governor"]),
        ({"sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance"}, []),
        ({"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16"}, ["serial adapter"]),
        ({"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1"}, []),
    ],
)
def test_what_makes_ticks_late_is_named_with_its_remedy(
    tmp_path: Path, files: dict[str, str], warned: list[str]
) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(f"{content}\n")
    found = list(check_kernel(tmp_path))
    assert [finding.what for finding in found if finding.state == "warn"] == warned
    assert all(finding.fix for finding in found if finding.state == "warn")


def test_doctor_serial_port_in_use_is_named_then_free(tmp_path: Path) -> None:
    port = tmp_path / "dev" / "ttyUSB0"
    port.parent.mkdir()
    port.write_text("")

    def said() -> tuple[str, str]:
        (finding,) = (one for one in check_kernel(tmp_path) if one.what == "serial port")
        return finding.state, finding.detail

    assert said() == ("ok", "ttyUSB0 can be opened")
    with port.open("r+") as holder:
        fcntl.flock(holder, fcntl.LOCK_EX)
        assert said() == ("warn", "ttyUSB0 is in use by another program")
    assert said()[0] == "ok"
