"""Processes are killed with SIGKILL while the robot is armed, and a listener on the bus measures what follows.

Host, control and modules are the processes of `snakesim run` and `snakesim drive emulate can`. The listener has the
kernel's time of every frame. `pytest -rP tests/system/can/test_killed.py` prints a row for each.
"""

import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_can_backend.can_command import COLUMNS
from snakesim_can_backend.protocol.definitions import (
    LastStop,
    ModuleState,
    Opcode,
    parse_node,
)
from snakesim_testing.can.listened_bus import (
    IN_GUEST,
    JOINT_COUNT,
    LATE_MS,
    NODES,
    RATE_HZ,
    RobotOnBus,
    find_first_reports,
    measure_module_duration_ms,
    open_robot_on_bus,
    read_uptimes_ms,
    select_stop_commands,
)
from snakesim_testing.runs.in_process_command import snakesim

# Several processes in real time are more than a busy emulated machine is sure to keep up with: ARGS="-m slow".
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture
def robot(tmp_path: Path, channel: str) -> Iterator[RobotOnBus]:
    """Provide the processes of a robot on the bus."""
    with open_robot_on_bus(tmp_path, channel) as robot:
        yield robot


def kill_process(process: subprocess.Popen[bytes]) -> int:
    """Send SIGKILL to a process and return the time of the signal by the clock of the listener, in ns."""
    now_ns = time.time_ns()
    process.kill()
    process.wait()
    return now_ns


def test_killed_controller_makes_driver_stop_the_modules(robot: RobotOnBus) -> None:
    _, control = robot.arm()
    killed_ns = kill_process(control)
    passive = {ModuleState.DISARMED}
    robot.wait_until(
        lambda: (
            len(find_first_reports(robot.listener.receive_frames(), passive, killed_ns))
            == JOINT_COUNT
        ),
        "modules stopped",
    )
    robot.wait_until(
        lambda: "lease of control expired" in robot.run_command("status").printed,
        "the fault in the status",
    )
    received = list(robot.listener.receive_frames())
    setpoint_times_ns = [frame.at_ns for frame in received if frame.opcode == Opcode.SET_POINT]
    last_ms = (max(setpoint_times_ns) - killed_ns) / 1e6
    stop = next(frame for frame in select_stop_commands(received) if frame.at_ns > killed_ns)
    stop_ms = (stop.at_ns - killed_ns) / 1e6
    first_reports = find_first_reports(received, passive, killed_ns).values()
    rest_ms = max((report.at_ns - stop.at_ns) / 1e6 for report in first_reports)
    lease_ms = robot.config.lease_ns / 1e6
    period_ms = robot.config.period_ns / 1e6
    assert last_ms <= stop_ms <= lease_ms + 2 * period_ms + LATE_MS
    assert rest_ms <= 100 + period_ms + LATE_MS
    print(
        f"| control, SIGKILL | last setpoint {last_ms:.0f} ms after it, Stop {stop_ms:.0f} ms "
        f"(lease {lease_ms:.0f} ms, {RATE_HZ:g} Hz) | all modules DISARMED {rest_ms:.0f} ms after Stop "
        f"| kernel's clock{', emulated machine' if IN_GUEST else ''} |"
    )


def test_killed_host_leads_to_watchdog_stop_of_every_module(
    robot: RobotOnBus, channel: str
) -> None:
    host, _ = robot.arm()
    armed = [ModuleState.ARMED] * JOINT_COUNT
    assert robot.listener.states() == armed, robot.read_log("host")
    killed_ns = kill_process(host)
    period_ms = robot.config.period_ns / 1e6
    fault = {ModuleState.FAULT}
    robot.wait_until(
        lambda: (
            len(find_first_reports(robot.listener.receive_frames(), fault, killed_ns))
            == JOINT_COUNT
        ),
        "modules in fault",
    )
    beats = {node: len(read_uptimes_ms(robot.listener.receive_frames(), node)) for node in NODES}
    robot.wait_until(
        lambda: all(
            len(read_uptimes_ms(robot.listener.receive_frames(), node)) > beats[node] + 1
            for node in NODES
        ),
        "heartbeats",
    )
    received = robot.listener.received
    stopped = find_first_reports(received, fault, killed_ns)
    for report in stopped.values():
        assert report.opcode == Opcode.HEARTBEAT  # a heartbeat needs no Sync of the host
        values = report.decode()
        assert values["last_stop"] == LastStop.WATCHDOG
        assert values["fault_watchdog"]
        assert values["mode"] == 0
    last_setpoint_ns = {
        node: max(
            frame.at_ns
            for frame in received
            if frame.opcode == Opcode.SET_POINT and parse_node(frame.frame.id) == node
        )
        for node in NODES
    }
    host_opcodes = (Opcode.SET_POINT, Opcode.SYNC, Opcode.COMMAND)
    host_frame_times_ns = [frame.at_ns for frame in received if frame.opcode in host_opcodes]
    last_ms = (max(host_frame_times_ns) - killed_ns) / 1e6
    # The time from the last setpoint to the stop, by the clock of the kernel and by the clocks of the modules.
    kernel_ms = [(stopped[node].at_ns - last_setpoint_ns[node]) / 1e6 for node in NODES]
    module_ms = [
        measure_module_duration_ms(received, node, last_setpoint_ns[node], stopped[node].at_ns)
        for node in NODES
    ]
    assert last_ms < LATE_MS
    assert max(kernel_ms) <= 100 + period_ms + LATE_MS
    assert max(module_ms) <= 100 + period_ms
    assert min(module_ms) > 100 - period_ms
    assert robot.listener.states() == [ModuleState.FAULT] * JOINT_COUNT
    print(
        f"| host, SIGKILL | last frame {last_ms:.1f} ms after it | all modules FAULT (watchdog), "
        f"motor off, {max(kernel_ms):.0f} ms after their last setpoint by the kernel's clock, "
        f"{min(module_ms):.0f} to {max(module_ms):.0f} ms by their own | watchdog 100 ms |"
    )

    # A later scan of the bus shows the faults.
    scan = snakesim("drive", "scan", "can", channel, "--duration", "3", cwd=robot.folder)
    lines = scan.out.splitlines()
    assert scan.code == 0, scan.out + scan.err
    assert lines[0].split() == list(COLUMNS), scan.out + scan.err
    rows = [dict(zip(COLUMNS, line.split(), strict=False)) for line in lines[1:]]
    assert [row["node"] for row in rows] == [str(node) for node in NODES]
    for row in rows:
        assert row["emulated"] == "yes"
        assert row["state"] == "fault"
        assert row["faults"] == "watchdog"
    assert len({row["serial"] for row in rows}) == JOINT_COUNT
    print(
        f"| `snakesim drive scan can {channel}` afterwards | {'; '.join(' '.join(line.split()) for line in lines)} |"
    )
