"""The units of a lab give each host the buses of the lab file and access to them, or rendering is refused."""

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
ROBOT_TABLES = {  # lines of the lab file
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
HOST_BACKENDS = {  # configuration of the backends that the host must get
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
CAN_FD_LINK = "type can bitrate 1000000 dbitrate {} fd on restart-ms"
LINK_SETTINGS = {  # of `ip link set`, by interface
    "can": {
        "can0": "type can bitrate 500000 restart-ms",
        "can1": "type can bitrate 500000 restart-ms",
    },
    "odrive": {"can0": "type can bitrate 1000000 restart-ms"},
    "moteus": {"can0": CAN_FD_LINK.format(2_000_000)},
    "cia402": {"can0": "type can bitrate 500000 restart-ms"},
    "virtual moteus": {"vcan0": "mtu 72"},
    "mixed": {"can0": "type can bitrate 1000000 restart-ms", "can1": CAN_FD_LINK.format(5_000_000)},
}
HOST_UNIT = "robot1/systemd/snakesim-robot.planar13.service"
DEVICES = {  # to which the host needs access
    "slcan": ["/dev/ttyACM0"],
    "dynamixel": ["/dev/ttyUSB0", BY_ID],
    "mixed": ["/dev/ttyUSB0"],
}


def make_lab_text(robot_lines: str) -> str:
    """Return the text of the example lab file with another robot."""
    text, count = re.subn(
        r'backend = "sim".*\ncan = .*\n', f"{robot_lines}\n", EXAMPLE_PATH.read_text()
    )
    assert count == 1
    return text


def render_lab(robot_lines: str, folder: Path) -> dict[str, str]:
    """Return the rendered files of a lab with this robot, by machine and name."""
    path = folder / "lab.toml"
    path.write_text(make_lab_text(robot_lines))
    return {f"{machine}/{name}": text for (machine, name), text in render_files(load_lab(path))}


def read_arguments(unit: str) -> list[str]:
    """Return the arguments of the program that a systemd unit starts."""
    command = re.search(r"^ExecStart=(.*)$", unit, re.MULTILINE)
    assert command is not None
    return shlex.split(command[1])[3:]  # after `snakesim start host` or `snakesim start service`


@pytest.mark.parametrize("name", ROBOT_TABLES)
def test_lab_host_and_services_get_the_configured_buses(tmp_path: Path, name: str) -> None:
    """The host refuses a service whose configuration differs from its own."""
    files = render_lab(ROBOT_TABLES[name], tmp_path)
    host_parser = argparse.ArgumentParser()
    add_host_arguments(host_parser)
    service_parser = argparse.ArgumentParser()
    add_service_arguments(service_parser)
    host = host_parser.parse_args(read_arguments(files[HOST_UNIT]))
    config = load_scenario_from_arguments(host).config
    backends = {section: settings for section, settings in config.backends.items() if settings}
    assert backends == HOST_BACKENDS[name]
    assert config.clock_mode == ("realtime" if HOST_BACKENDS[name] else "lockstep")
    control = service_parser.parse_args(
        read_arguments(files["ws1/systemd/snakesim-gnc.planar13-control.service"])
    )
    assert load_scenario_from_arguments(control).config == config


@pytest.mark.parametrize("name", ROBOT_TABLES)
def test_lab_units_bring_up_interfaces_and_grant_device_access(tmp_path: Path, name: str) -> None:
    files = render_lab(ROBOT_TABLES[name], tmp_path)
    interface_units = [path for path in files if re.search(r"snakesim-v?can\d+\.service$", path)]
    link_settings = LINK_SETTINGS.get(name, {})
    assert {path.split("-")[1].removesuffix(".service") for path in interface_units} == set(
        link_settings
    )
    for interface, settings in link_settings.items():
        unit = files[f"robot1/systemd/snakesim-{interface}.service"]
        assert f"/sbin/ip link set {interface} {settings}" in unit
    host = files[HOST_UNIT]
    container = yaml.safe_load(files["robot1/compose.yaml"])["services"]["snakesim-robot_planar13"]
    assert ("AF_CAN" in host) == bool(link_settings)
    devices = DEVICES.get(name, [])
    allowed_devices = re.findall(r"^DeviceAllow=(/\S+) rw$", host, re.MULTILINE)
    assert allowed_devices == devices
    assert container.get("devices", []) == [f"{path}:{path}" for path in devices]
    assert ("SupplementaryGroups=dialout" in host) == bool(devices) == ("group_add" in container)
    assert ("PrivateDevices=yes" in host) != bool(devices) == ("DevicePolicy=closed" in host)
    for path, text in files.items():
        if path.endswith(".service") and text is not host:
            assert "DeviceAllow" not in text and "PrivateDevices=yes" in text, path


@pytest.mark.parametrize(
    "robot_lines",
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
def test_lab_robot_with_missing_or_conflicting_bus_is_refused(
    tmp_path: Path, robot_lines: str
) -> None:
    with raises_error(
        ConfigError, code=("config/invalid-value", "lab/invalid-file"), field="lab.toml"
    ):
        render_lab(robot_lines, tmp_path)


def test_lab_bus_of_two_robots_is_refused(tmp_path: Path) -> None:
    second_robot = '\n[robots.second]\nmachine = "robot1"\nscenario = "triplet"\nbackend = "odrive"\ncan = ["can0"]\n'
    path = tmp_path / "lab.toml"
    path.write_text(make_lab_text(ROBOT_TABLES["can"]) + second_robot)
    with raises_error(ConfigError, code="lab/invalid-file", field="robot1"):
        load_lab(path)


def test_lab_bus_of_external_backend_is_passed_as_setting(tmp_path: Path) -> None:
    robot_lines = (
        'backend = "ethercat"\nset = ["backends.ethercat.ports=[\'eth 1\']"]\n'
        'devices = ["/dev/cpu_dma_latency"]'
    )
    host = render_lab(robot_lines, tmp_path)[HOST_UNIT]
    assert "backends.ethercat.ports=['eth 1']" in read_arguments(host)
    assert "DeviceAllow=/dev/cpu_dma_latency rw" in host


@pytest.mark.parametrize(
    ("name", "emulated", "problem"),
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
def test_lab_check_marks_robot_that_contradicts_lab_file(
    tmp_path: Path, name: str, emulated: bool | None, problem: str
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(make_lab_text(ROBOT_TABLES[name]))
    description = None
    if emulated is not None:
        description = msgspec.structs.replace(make_description(), emulated=emulated)
    lines: list[str] = []
    results = CheckResults(lines.append)
    check_emulation(load_lab(path).file.robots["planar13"], description, results)
    assert results.wrong == bool(problem)
    assert problem in lines[0]
