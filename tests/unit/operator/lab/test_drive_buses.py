"""A lab's robot is driven through the buses that its file names, by units that let it; or nothing is rendered."""

import argparse
import re
import shlex
from pathlib import Path

import msgspec
import pytest
import yaml

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import (
    add_host_arguments,
    add_service_arguments,
    load_scenario_from_arguments,
)
from snakesim_operator.features.lab.check import CheckResults, check_emulation
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH, load_lab
from snakesim_operator.features.lab.render import render_files
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.messages import raises_error

BY_ID = "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT4-if00-port0"
ROBOTS = {
    "can": 'backend = "can"\ncan = ["can0", "can1"]\nbitrate = 500000',
    "slcan": 'backend = "can"\ncan = ["slcan:/dev/ttyACM0"]',
    "odrive": 'backend = "odrive"\ncan = ["can0"]',
    "moteus": 'backend = "moteus"\ncan = ["can0"]\ndata_bitrate = 2000000',
    "cia402": 'backend = "cia402"\ncan = ["can0"]\nbitrate = 500000',
    "virtual moteus": 'backend = "moteus"\ncan = ["vcan0"]',
    "dynamixel": f'backend = "dynamixel"\nserial = ["/dev/ttyUSB0", "{BY_ID}"]',
    "mixed": 'backend = "mixed"\ncan = ["can0", "can1"]\nserial = ["/dev/ttyUSB0"]\n'
    'buses = { odrive = ["can0"], moteus = ["can1"], dynamixel = ["/dev/ttyUSB0"] }',
    "emulated": 'backend = "moteus"\nemulated = true',
    "sim": 'backend = "sim"\ncan = ["can0"]',
}
BUSES = {  # as the host is to be given them
    "can": {"can": {"channels": ["can0", "can1"], "bit_rate": 500_000}},
    "slcan": {"can": {"channels": ["slcan:/dev/ttyACM0"], "bit_rate": 1_000_000}},
    "odrive": {"odrive": {"channels": ["can0"], "bit_rate": 1_000_000}},
    "moteus": {"moteus": {"channels": ["can0"], "bit_rate": 1_000_000, "data_bit_rate": 2_000_000}},
    "cia402": {"cia402": {"channels": ["can0"], "bit_rate": 500_000}},
    "virtual moteus": {
        "moteus": {"channels": ["vcan0"], "bit_rate": 1_000_000, "data_bit_rate": 5_000_000}
    },
    "dynamixel": {"dynamixel": {"ports": ["/dev/ttyUSB0", BY_ID]}},
    "mixed": {
        "odrive": {"channels": ["can0"], "bit_rate": 1_000_000},
        "moteus": {"channels": ["can1"], "bit_rate": 1_000_000, "data_bit_rate": 5_000_000},
        "dynamixel": {"ports": ["/dev/ttyUSB0"]},
    },
    "emulated": {},
    "sim": {},
}
CAN_FD = "type can bitrate 1000000 dbitrate {} fd on restart-ms"
BRING_UP = {
    "can": {
        "can0": "type can bitrate 500000 restart-ms",
        "can1": "type can bitrate 500000 restart-ms",
    },
    "odrive": {"can0": "type can bitrate 1000000 restart-ms"},
    "moteus": {"can0": CAN_FD.format(2_000_000)},
    "cia402": {"can0": "type can bitrate 500000 restart-ms"},
    "virtual moteus": {"vcan0": "mtu 72"},
    "mixed": {"can0": "type can bitrate 1000000 restart-ms", "can1": CAN_FD.format(5_000_000)},
}
DEVICES = {
    "slcan": ["/dev/ttyACM0"],
    "dynamixel": ["/dev/ttyUSB0", BY_ID],
    "mixed": ["/dev/ttyUSB0"],
}


def lab_text(robot: str) -> str:
    """The example with another robot."""
    text, count = re.subn(r'backend = "sim".*\ncan = .*\n', f"{robot}\n", EXAMPLE_PATH.read_text())
    assert count == 1
    return text


def files_of(robot: str, folder: Path) -> dict[str, str]:
    path = folder / "lab.toml"
    path.write_text(lab_text(robot))
    return {f"{machine}/{name}": text for (machine, name), text in render_files(load_lab(path))}


def command_of(unit: str) -> list[str]:
    line = re.search(r"^ExecStart=(.*)$", unit, re.MULTILINE)
    assert line is not None
    return shlex.split(line[1])[3:]  # without the program and its two words, such as `start host`


@pytest.mark.parametrize("name", ROBOTS)
def test_the_host_is_given_its_buses(tmp_path: Path, name: str) -> None:
    """And its services have the same configuration, or they would be refused as set up differently."""
    files = files_of(ROBOTS[name], tmp_path)
    host_parser, service_parser = argparse.ArgumentParser(), argparse.ArgumentParser()
    add_host_arguments(host_parser)
    add_service_arguments(service_parser)
    host = host_parser.parse_args(
        command_of(files["robot1/systemd/snakesim-robot.planar13.service"])
    )
    config = load_scenario_from_arguments(host).config
    given = {section: settings for section, settings in config.backends.items() if settings}
    assert given == BUSES[name]
    assert config.clock_mode == ("realtime" if BUSES[name] else "lockstep")
    control = service_parser.parse_args(
        command_of(files["ws1/systemd/snakesim-gnc.planar13-control.service"])
    )
    assert load_scenario_from_arguments(control).config == config


@pytest.mark.parametrize("name", ROBOTS)
def test_units_bring_interfaces_up_and_grant_device_access(tmp_path: Path, name: str) -> None:
    files = files_of(ROBOTS[name], tmp_path)
    interfaces = {
        path: text
        for path, text in files.items()
        if re.search(r"snakesim-v?can\d+\.service$", path)
    }
    wanted = BRING_UP.get(name, {})
    assert {path.split("-")[1].removesuffix(".service") for path in interfaces} == set(wanted)
    for interface, words in wanted.items():
        assert (
            f"/sbin/ip link set {interface} {words}"
            in files[f"robot1/systemd/snakesim-{interface}.service"]
        )
    host = files["robot1/systemd/snakesim-robot.planar13.service"]
    service = yaml.safe_load(files["robot1/compose.yaml"])["services"]["snakesim-robot_planar13"]
    assert ("AF_CAN" in host) == bool(wanted)
    devices = DEVICES.get(name, [])
    allowed = re.findall(r"^DeviceAllow=(/\S+) rw$", host, re.MULTILINE)
    assert allowed == devices
    assert service.get("devices", []) == [f"{path}:{path}" for path in devices]
    assert ("SupplementaryGroups=dialout" in host) == bool(devices) == ("group_add" in service)
    assert ("PrivateDevices=yes" in host) != bool(devices) == ("DevicePolicy=closed" in host)
    for path, text in files.items():
        if path.endswith(".service") and text is not host:
            assert "DeviceAllow" not in text and "PrivateDevices=yes" in text, path


@pytest.mark.parametrize(
    "robot",
    [
        'backend = "can"',
        'backend = "odrive"',
        'backend = "moteus"\nserial = ["/dev/ttyUSB0"]',
        'backend = "dynamixel"',
        'backend = "dynamixel"\ncan = ["can0"]',
        'backend = "mixed"\ncan = ["can0"]',
        'backend = "mixed"\ncan = ["can0"]\nbuses = { odrivee = ["can0"] }',
        'backend = "mixed"\ncan = ["can0"]\nbuses = { odrive = ["can1"] }',
        'backend = "mixed"\ncan = ["can0", "can1"]\nbuses = { odrive = ["can0"] }',
        'backend = "mixed"\ncan = ["can0"]\nbuses = { odrive = ["can0"], moteus = ["can0"] }',
        'backend = "can"\ncan = ["can0"]\nbuses = { can = ["can0"] }',
        'backend = "can"\ncan = ["can0"]\nset = ["backend.channels=[]"]',
        'backend = "odrive"\ncan = ["can0"]\nset = ["backends.odrive.bit_rate=500000"]',
        'backend = "ethercat"\ncan = ["can0"]',
        'backend = "dynamixel"\nserial = ["ttyUSB0"]',
    ],
)
def test_a_robot_without_its_bus_is_refused(tmp_path: Path, robot: str) -> None:
    with raises_error(
        ConfigError, code=("config/invalid-value", "lab/invalid-file"), field="lab.toml"
    ):
        files_of(robot, tmp_path)


def test_a_bus_is_of_one_robot(tmp_path: Path) -> None:
    second = '\n[robots.second]\nmachine = "robot1"\nscenario = "triplet"\nbackend = "odrive"\ncan = ["can0"]\n'
    path = tmp_path / "lab.toml"
    path.write_text(lab_text(ROBOTS["can"]) + second)
    with raises_error(ConfigError, code="lab/invalid-file", field="robot1"):
        load_lab(path)


def test_bus_of_an_external_backend_is_passed_as_setting(tmp_path: Path) -> None:
    robot = 'backend = "ethercat"\nset = ["backends.ethercat.ports=[\'eth 1\']"]\ndevices = ["/dev/cpu_dma_latency"]'
    host = files_of(robot, tmp_path)["robot1/systemd/snakesim-robot.planar13.service"]
    assert "backends.ethercat.ports=['eth 1']" in command_of(host)
    assert "DeviceAllow=/dev/cpu_dma_latency rw" in host


@pytest.mark.parametrize(
    ("name", "emulated", "wrong"),
    [
        ("can", True, "EMULATED: nothing real moves (backend lag), but the lab file names its bus"),
        ("can", False, ""),
        ("dynamixel", True, "but the lab file names its bus"),
        ("mixed", True, "but the lab file names its bus"),
        ("virtual moteus", True, ""),
        ("emulated", True, ""),
        (
            "emulated",
            False,
            "REAL: motors move (backend lag), but by the lab file nothing real is to move",
        ),
        ("sim", False, "but by the lab file nothing real is to move"),
        ("sim", None, "UNKNOWN whether motors move"),
    ],
)
def test_check_marks_robot_that_contradicts_lab_file(
    tmp_path: Path, name: str, emulated: bool | None, wrong: str
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(lab_text(ROBOTS[name]))
    described = (
        None if emulated is None else msgspec.structs.replace(make_description(), emulated=emulated)
    )
    said: list[str] = []
    found = CheckResults(said.append)
    check_emulation(load_lab(path).file.robots["planar13"], described, found)
    assert found.wrong == bool(wrong)
    assert wrong in said[0]
