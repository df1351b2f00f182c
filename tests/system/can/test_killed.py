"""Processes that are killed with SIGKILL while the robot is armed, as a listener on the bus sees it.

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
    with open_robot_on_bus(tmp_path, channel) as made:
        yield made


def killed(process: subprocess.Popen[bytes]) -> int:
    """SIGKILL; when, by the clock of the listener."""
    now_ns = time.time_ns()
    process.kill()
    process.wait()
    return now_ns


def test_a_killed_controller_makes_the_driver_stop_the_modules(robot: RobotOnBus) -> None:
    _, control = robot.arm()
    killed_ns = killed(control)
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
    last_ms = (max(h.at_ns for h in received if h.opcode == Opcode.SET_POINT) - killed_ns) / 1e6
    stop = next(h for h in select_stop_commands(received) if h.at_ns > killed_ns)
    stop_ms = (stop.at_ns - killed_ns) / 1e6
    rest_ms = max(
        (h.at_ns - stop.at_ns) / 1e6
        for h in find_first_reports(received, passive, killed_ns).values()
    )
    lease_ms, period_ms = robot.config.lease_ns / 1e6, robot.config.period_ns / 1e6
    assert last_ms <= stop_ms <= lease_ms + 2 * period_ms + LATE_MS
    assert rest_ms <= 100 + period_ms + LATE_MS
    print(
        f"| control, SIGKILL | last setpoint {last_ms:.0f} ms after it, Stop {stop_ms:.0f} ms "
        f"(lease {lease_ms:.0f} ms, {RATE_HZ:g} Hz) | all modules DISARMED {rest_ms:.0f} ms after Stop "
        f"| kernel's clock{', emulated machine' if IN_GUEST else ''} |"
    )


def test_a_killed_host_leaves_every_module_to_its_own_watchdog(
    robot: RobotOnBus, channel: str
) -> None:
    host, _ = robot.arm()
    armed = [ModuleState.ARMED] * JOINT_COUNT
    assert robot.listener.states() == armed, robot.read_log("host")
    killed_ns = killed(host)
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
    assert all(h.opcode == Opcode.HEARTBEAT for h in stopped.values()), (
        "told at once, without a Sync"
    )
    assert {h.decode()["last_stop"] for h in stopped.values()} == {LastStop.WATCHDOG}
    assert all(h.decode()["fault_watchdog"] and h.decode()["mode"] == 0 for h in stopped.values())
    last = {
        node: max(
            h.at_ns
            for h in received
            if h.opcode == Opcode.SET_POINT and parse_node(h.frame.id) == node
        )
        for node in NODES
    }
    from_host = [
        h.at_ns for h in received if h.opcode in (Opcode.SET_POINT, Opcode.SYNC, Opcode.COMMAND)
    ]
    last_ms = (max(from_host) - killed_ns) / 1e6
    took_ms = [(stopped[node].at_ns - last[node]) / 1e6 for node in NODES]
    own_ms = [
        measure_module_duration_ms(received, node, last[node], stopped[node].at_ns)
        for node in NODES
    ]
    assert last_ms < LATE_MS
    assert max(took_ms) <= 100 + period_ms + LATE_MS
    assert max(own_ms) <= 100 + period_ms
    assert min(own_ms) > 100 - period_ms
    assert robot.listener.states() == [ModuleState.FAULT] * JOINT_COUNT
    print(
        f"| host, SIGKILL | last frame {last_ms:.1f} ms after it | all modules FAULT (watchdog), "
        f"motor off, {max(took_ms):.0f} ms after their last setpoint by the kernel's clock, "
        f"{min(own_ms):.0f} to {max(own_ms):.0f} ms by their own | watchdog 100 ms |"
    )

    # Whoever looks afterwards sees it.
    scanned = snakesim("drive", "scan", "can", channel, "--duration", "3", cwd=robot.folder)
    lines = scanned.out.splitlines()
    assert scanned.code == 0 and lines[0].split() == list(COLUMNS), scanned.out + scanned.err
    rows = [dict(zip(COLUMNS, line.split(), strict=False)) for line in lines[1:]]
    assert [r["node"] for r in rows] == [str(node) for node in NODES]
    assert all(
        (r["emulated"], r["state"], r["faults"]) == ("yes", "fault", "watchdog") for r in rows
    )
    assert len({r["serial"] for r in rows}) == JOINT_COUNT
    print(
        f"| `snakesim drive scan can {channel}` afterwards | {'; '.join(' '.join(line.split()) for line in lines)} |"
    )
