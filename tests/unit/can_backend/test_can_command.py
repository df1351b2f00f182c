"""`snakesim drive` for joint modules: the load of a bus, a scan of its nodes, and the complete DBC file."""

import re
import uuid
from functools import partial
from pathlib import Path

import can
import pytest

from snakesim_can_backend.bus.bus import VirtualWire, to_python_can
from snakesim_can_backend.bus.load import compute_bus_load, plan_reports_at, validate_bus_load
from snakesim_can_backend.can_command import COLUMNS, UNKNOWN, load_can_settings, scan
from snakesim_can_backend.commands import COMMANDS
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.commands import make_command
from snakesim_can_backend.protocol.definitions import CanFrame, CommandAction, ModuleState, Opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import align_columns
from snakesim_hal.model.scenario import load_scenario as load_scenario
from snakesim_hal.model.scenario import parse_set_option
from snakesim_testing.can.frames import make_health_frame, make_heartbeat_frame
from snakesim_testing.messages import raises_error
from snakesim_testing.operator.registered_command import run_registered_command

run_command = partial(run_registered_command, COMMANDS)
TRIPLET = load_scenario("triplet").config

# --- load --------------------------------------------------------------------------------------------------


def test_load_command_prints_loads_and_their_sum(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["drive", "load", "can", "triplet"]) == 0
    output = capsys.readouterr().out
    assert "one bus: 13 joints at 100 Hz" in output
    assert "JointState       1300 frames/s x 135 bits (8 bytes) =  17.6 %" in output
    assert "together 56.7 %" in output
    assert "5.24 of 10.00 ms" in output
    assert "Refused" not in output


def test_load_command_of_overload_suggests_what_fits(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["drive", "load", "can", "triplet", "--set", "rate_hz=300"]) == 1
    assert "Refused. What would fit: rate_hz = " in capsys.readouterr().out


def test_load_command_uses_the_settings_of_the_backend(capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--set", 'backend.channels=["can0", "can1"]', "--set", "backend.contact_rate_hz=0"]
    assert run_command(["drive", "load", "can", "triplet", *flags]) == 0
    output = capsys.readouterr().out
    assert "can0: 7 joints" in output
    assert "can1: 6 joints" in output
    assert "Contact" not in output
    with raises_error(ConfigError, code="config/out-of-range"):
        run_command(["drive", "load", "can", "triplet", "--set", "backend.imu_rate_hz=-1"])


def test_load_command_with_several_rates_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    command = "drive load can triplet --joints 13 18 30 --hz 50 100 200"
    assert run_command(command.split()) == 0
    heading, *rows, note = capsys.readouterr().out.splitlines()
    assert heading.split() == ["joints", "50", "Hz", "100", "Hz", "200", "Hz"]
    for row, joints in zip(rows, (13, 18, 30), strict=True):
        cells = [
            f"{100 * compute_bus_load(joints, plan_reports_at(rate, TRIPLET, CanSettings())):.1f}"
            for rate in (50, 100, 200)
        ]
        assert [word for word in row.split() if "." in word] == cells
        assert row.count("refused") == sum(float(cell) > 80 for cell in cells)
    assert "80%" in note


def test_load_command_table_shows_the_fullest_bus(capsys: pytest.CaptureFixture[str]) -> None:
    two_channels = 'backend.channels=["can0", "can1"]'
    assert (
        run_command(["drive", "load", "can", "triplet", "--set", two_channels, "--joints", "13"])
        == 0
    )
    output = capsys.readouterr().out
    loaded = load_scenario(
        "triplet", [parse_set_option("backend=can"), parse_set_option(two_channels)]
    )
    assert (
        f"{100 * max(validate_bus_load(loaded.config, load_can_settings(loaded))):.1f} %" in output
    )
    assert "the fullest of 2 buses" in output


@pytest.mark.parametrize(
    "flags", [["--joints", "0"], ["--joints", "63"], ["--hz", "19"], ["--hz", "fast"]]
)
def test_load_command_with_invalid_joints_or_rate_is_refused(
    flags: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        run_command(["drive", "load", "can", "triplet", *flags])
    assert exit_info.value.code == 2
    assert flags[1] in capsys.readouterr().err


# --- dbc ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_dbc_command_into_a_file_as_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with raises_error(ConfigError, code="file/not-writable", field="all.dbc"):
        run_command(["drive", "dbc", "--out", str(tmp_path / "file" / "all.dbc")])


# --- scan --------------------------------------------------------------------------------------------------


def make_identity(node: int, serial: int) -> CanFrame:
    return load_layouts()[Opcode.IDENTITY].encode(
        node, serial=serial, firmware_major=1, protocol=1, emulated=1
    )


def scan_frames(*frames_on_bus: CanFrame) -> tuple[list[dict[str, str]], list[CanFrame]]:
    """Scan a bus on which these frames arrive, and return the rows of the scan and the frames that it sent."""
    channel = f"scan-{uuid.uuid4().hex[:8]}"
    wire = VirtualWire(channel)
    other_end = VirtualWire(channel)
    for frame in frames_on_bus:
        other_end.send(frame)
    rows = scan(wire, 0.25)
    sent_by_scan = other_end.receive()
    wire.close()
    other_end.close()
    return rows, sent_by_scan


def test_can_scan_lists_modules_by_node_and_serial() -> None:
    rows, _ = scan_frames(
        make_identity(62, 0xBEEF), make_identity(3, 0xCAFE), make_identity(3, 0xF00D)
    )
    assert [(row["node"], row["serial"]) for row in rows] == [
        ("3", "0000CAFE"),
        ("3", "0000F00D"),
        ("62", "0000BEEF"),
    ]


def test_can_scan_sends_only_requests_for_identities() -> None:
    _, sent_by_scan = scan_frames(make_identity(3, 0xCAFE), make_heartbeat_frame(3, 1.0))
    assert sent_by_scan
    assert set(sent_by_scan) == {make_command(CommandAction.IDENTIFY)}


def test_can_scan_of_reporting_module_has_all_values_with_units() -> None:
    (row,), _ = scan_frames(
        make_identity(3, 0xCAFE),
        make_heartbeat_frame(3, 12.34, ModuleState.FAULT, fault_leak=1, fault_voltage=1),
        make_health_frame(3, voltage=23.9, motor_temperature=41, board_temperature=33),
        load_layouts()[Opcode.SHAFT_LOAD].encode(3, torque=-1.25),
    )
    del row["channel"]
    assert row == {
        "node": "3",
        "serial": "0000CAFE",
        "firmware": "1.0",
        "protocol": "1",
        "emulated": "yes",
        "state": "fault",
        "faults": "leak+voltage",
        "uptime": "12.3 s",
        "voltage": "23.9 V",
        "motor": "41 °C",
        "board": "33 °C",
        "shaft": "-1.250 N·m",
    }


def test_can_scan_of_module_with_heartbeat_alone_has_only_state() -> None:
    (row,), _ = scan_frames(make_identity(62, 0xBEEF), make_heartbeat_frame(62, 1.0))
    assert row["state"] == "disarmed"
    assert row["faults"] == "none"
    assert row["voltage"] == UNKNOWN
    assert row["shaft"] == UNKNOWN


def test_can_scan_table_has_heading_and_one_line_per_module() -> None:
    rows, _ = scan_frames(make_identity(3, 0xCAFE), make_identity(62, 0xBEEF))
    heading, *lines = align_columns(COLUMNS, rows)
    assert heading.split() == list(COLUMNS)
    assert len(lines) == len(rows) == 2


def test_can_scan_of_minimal_module_invents_no_values() -> None:
    rows, _ = scan_frames(make_identity(5, 1), make_identity(0, 2), make_identity(63, 3))
    assert [row["node"] for row in rows] == ["0", "5", "63"]
    for row in rows:
        assert {
            row[name] for name in ("state", "faults", "uptime", "voltage", "motor", "shaft")
        } == {UNKNOWN}


def test_can_scan_of_an_empty_bus_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        run_command(
            ["drive", "scan", "can", f"virtual:scan-{uuid.uuid4().hex[:8]}", "--duration", "0.05"]
        )
        == 1
    )
    assert "no module answers" in capsys.readouterr().out


def test_can_scan_of_missing_interface_is_refused() -> None:
    with raises_error(ConfigError, code="bus/not-available"):
        run_command(["drive", "scan", "can", "nocan7"])


def test_can_scan_of_foreign_bus_names_it_and_sends_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    channel = f"scan-{uuid.uuid4().hex[:8]}"
    foreign_messages = [
        can.Message(arbitration_id=0x705, data=b"\x05", is_extended_id=False),
        can.Message(
            arbitration_id=0x061, data=bytes([0, 0, 0, 0, 8, 0, 0, 0]), is_extended_id=False
        ),
        can.Message(arbitration_id=0x1234567, data=bytes(8)),
        can.Message(arbitration_id=0x7FF, data=bytes(3), is_extended_id=False),
        to_python_can(make_heartbeat_frame(4, 1.0)),
    ]
    with can.Bus(interface="virtual", channel=channel) as bus:
        periodic_tasks = [bus.send_periodic(message, 0.01) for message in foreign_messages]
        exit_code = run_command(
            ["drive", "scan", "can", f"virtual:{channel}", "--duration", "0.05"]
        )
        assert bus.recv(0) is None, "the scan sent a frame"
        assert (
            run_command(
                ["drive", "scan", "can", f"virtual:{channel}", "--duration", "0.05", "--anyway"]
            )
            == 1
        )
        received = [bus.recv(0.5)]
        for task in periodic_tasks:
            task.stop()
    assert exit_code == 1
    assert received[0] is not None
    output = capsys.readouterr().out
    for pattern in (
        r"virtual:\S+: others use this bus, and nothing was sent; .*--anyway",
        r"  0x061  8 B  \d+ frames  as ODrive's heartbeat of node 3\n",
        r"  0x705  1 B  \d+ frames  as CANopen's heartbeat of node 5, operational\n",
        r"  0x7FF  3 B  \d+ frames  unknown\n",
        r"  0x01234567  8 B  \d+ frames  29-bit id\n",
    ):
        assert re.search(pattern, output), f"{pattern} is not in {output}"
    assert "0x1C4" not in output  # a heartbeat of a joint module
