"""Zenoh, systemd and container tools accept the files that `snakesim lab render` writes."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
import yaml
import zenoh

from snakesim_operator.cli import main
from snakesim_operator.features.lab.lab_file import EXAMPLE_PATH
from snakesim_testing.harness.command import run_program

ROBOT_SETTINGS = {
    "emulator": 'can = ["vcan0"]',
    "odrive": 'backend = "odrive"\ncan = ["can1"]',
    "moteus": 'backend = "moteus"\ncan = ["can2", "vcan1"]',
    "dynamixel": 'backend = "dynamixel"\nserial = ["/dev/ttyUSB0"]',
    "mixed": 'backend = "mixed"\ncan = ["can3"]\nserial = ["/dev/ttyUSB1"]\n'
    'buses = { odrive = ["can3"], dynamixel = ["/dev/ttyUSB1"] }',
    "emulated": 'backend = "moteus"\nemulated = true',
}
PROGRAM_CONFIGURATIONS = 8  # configuration files of the example lab and of its second router
PROGRAM_UNITS = 7  # systemd units of the same programs
CAN_UNITS = 6  # systemd units that configure CAN interfaces
MAX_EXPOSURE_LEVEL = 2.5  # of 10; systemd-analyze rates a unit below this level as "OK"
MACHINE_HEADER = re.compile(r"^\[machines\.\w+\]$", re.MULTILINE)
needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze here"
)


@pytest.fixture(scope="module")
def rendered_lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render the example lab with a second router and a robot of every drive type.

    Every machine runs the `snakesim` of this environment, so that systemd finds the program.
    """
    folder = tmp_path_factory.mktemp("rendered")
    program = Path(sys.executable).with_name("snakesim")
    text = MACHINE_HEADER.sub(rf'\g<0>\nprogram = "{program}"', EXAMPLE_PATH.read_text())
    text = text.replace('backend = "sim"', 'backend = "can"')
    text += '\n[routers.second]\nmachine = "hub"\nport = 7448\n'
    for name, settings in ROBOT_SETTINGS.items():
        text += f'\n[robots.{name}]\nmachine = "robot1"\nscenario = "triplet"\nset = ["rate_hz=50"]\n{settings}\n'
    (folder / "lab.toml").write_text(text)
    assert main(["lab", "render", str(folder / "lab.toml"), "--out", str(folder)]) == 0
    return folder


def test_rendered_zenoh_files_have_expected_mode_and_no_scouting(rendered_lab: Path) -> None:
    files = sorted(rendered_lab.rglob("*.json5"))
    assert len(files) == PROGRAM_CONFIGURATIONS + len(ROBOT_SETTINGS)
    for path in files:
        settings = zenoh.Config.from_file(str(path))
        mode = "router" if path.name.startswith("router.") else "client"
        assert settings.get_json("mode") == f'"{mode}"', path.name
        assert '"enabled":true' not in settings.get_json("scouting").replace(" ", ""), path.name


@needs_systemd
def test_rendered_systemd_units_are_valid_and_sandboxed(rendered_lab: Path) -> None:
    units = sorted(rendered_lab.rglob("*.service"))
    assert len(units) == PROGRAM_UNITS + len(ROBOT_SETTINGS) + CAN_UNITS
    verification = run_program(["systemd-analyze", "verify", "--man=no", *units], rendered_lab)
    assert verification.code == 0
    assert verification.err == ""
    for unit in units:
        rating = run_program(
            ["systemd-analyze", "security", "--offline=true", "--no-pager", unit], rendered_lab
        )
        level = re.search(r"exposure level for \S+: ([\d.]+)", rating.out)
        assert level is not None, f"{unit.name}: {rating.printed[-200:]}"
        assert float(level[1]) <= MAX_EXPOSURE_LEVEL, f"{unit.name}: {rating.printed[-200:]}"


def test_rendered_containers_run_commands_of_systemd_units(rendered_lab: Path) -> None:
    for compose in rendered_lab.rglob("compose.yaml"):
        services = yaml.safe_load(compose.read_text())["services"]
        units = [
            unit.read_text() for unit in (compose.parent / "systemd").glob("snakesim-[gr]*.service")
        ]
        container_commands = sorted(service["command"][1:] for service in services.values())
        start_lines = [re.search(r"^ExecStart=\S+ (.*)$", unit, re.MULTILINE) for unit in units]
        unit_commands = [shlex.split(line[1]) for line in start_lines if line is not None]
        assert container_commands == sorted(unit_commands)


def test_lab_render_deletes_only_files_of_removed_roles(tmp_path: Path) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(EXAMPLE_PATH.read_text())
    assert main(["lab", "render", str(lab), "--out", str(tmp_path)]) == 0
    (tmp_path / "laptop" / "notes.txt").write_text("mine")
    lab.write_text(EXAMPLE_PATH.read_text().replace('role = "viewer"', 'role = "administrator"'))
    assert main(["lab", "render", str(lab), "--out", str(tmp_path)]) == 0
    remaining_names = {path.name for path in (tmp_path / "laptop").iterdir()}
    assert remaining_names == {
        "notes.txt",
        "rendered.txt",
        "operator.planar13.json5",
        "administrator.planar13.json5",
    }
