"""`snakesim doctor` checks this computer, and names a remedy for each problem."""

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


@pytest.mark.heavy
def test_doctor_reports_all_findings_and_keeps_scheduler_of_process(
    capsys: pytest.CaptureFixture[str],
) -> None:
    scheduler_before = os.sched_getscheduler(0)
    assert main(["doctor", "--json", "--endpoint", find_free_endpoint()]) == 1, (
        "a robot answered at a free endpoint"
    )
    report = json.loads(capsys.readouterr().out)
    assert {"Python", "OpenGL", "CAN", "disk", "kernel"} < {
        finding["what"] for finding in report["findings"]
    }
    assert not report["ok"]
    assert report["findings"][-1]["state"] == "fail"
    for finding in report["findings"]:
        assert finding["state"] in ("ok", "warn", "fail")
        assert finding["detail"]
        # Nothing can be done about a computer without KVM.
        assert finding["state"] == "ok" or finding["fix"] or finding["what"] == "KVM"
    assert os.sched_getscheduler(0) == scheduler_before


def test_doctor_endpoint_without_zenoh_fails_within_seconds() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent_server:
        (finding,) = check_routers(
            RobotSelection(f"tcp/127.0.0.1:{silent_server.getsockname()[1]}")
        )
    assert finding.state == "fail"
    assert finding.fix


def test_doctor_default_port_is_free_or_in_use() -> None:
    (finding,) = check_ports()
    assert finding.what == "port 7447"
    assert finding.state in ("ok", "warn")


@pytest.mark.parametrize(
    ("files", "expected_warnings"),
    [
        ({"proc/version": "Linux version 6.12 SMP PREEMPT_DYNAMIC"}, ["kernel"]),
        ({"proc/version": "Linux version 6.12-rt SMP PREEMPT_RT"}, []),
        ({"sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave"}, ["governor"]),
        ({"sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance"}, []),
        ({"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "16"}, ["serial adapter"]),
        ({"sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1"}, []),
    ],
)
def test_doctor_kernel_setting_that_delays_ticks_is_a_warning(
    tmp_path: Path, files: dict[str, str], expected_warnings: list[str]
) -> None:
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text(f"{content}\n")
    warnings = [finding for finding in check_kernel(tmp_path) if finding.state == "warn"]
    assert [finding.what for finding in warnings] == expected_warnings
    assert all(finding.fix for finding in warnings)


def test_doctor_serial_port_in_use_is_named_then_free(tmp_path: Path) -> None:
    port = tmp_path / "dev" / "ttyUSB0"
    port.parent.mkdir()
    port.write_text("")

    def check_serial_port() -> tuple[str, str]:
        findings = check_kernel(tmp_path)
        (finding,) = (finding for finding in findings if finding.what == "serial port")
        return finding.state, finding.detail

    assert check_serial_port() == ("ok", "ttyUSB0 can be opened")
    with port.open("r+") as locked_port:
        fcntl.flock(locked_port, fcntl.LOCK_EX)
        assert check_serial_port() == ("warn", "ttyUSB0 is in use by another program")
    assert check_serial_port()[0] == "ok"
