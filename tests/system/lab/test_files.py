"""What `snakesim lab render` writes is accepted by those who read it: Zenoh, systemd, and a container's compose."""

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

ROBOTS = {
    "emulator": 'can = ["vcan0"]',
    "odrive": 'backend = "odrive"\ncan = ["can1"]',
    "moteus": 'backend = "moteus"\ncan = ["can2", "vcan1"]',
    "dynamixel": 'backend = "dynamixel"\nserial = ["/dev/ttyUSB0"]',
    "mixed": 'backend = "mixed"\ncan = ["can3"]\nserial = ["/dev/ttyUSB1"]\n'
    'buses = { odrive = ["can3"], dynamixel = ["/dev/ttyUSB1"] }',
    "emulated": 'backend = "moteus"\nemulated = true',
}
MAX_EXPOSED = 2.5  # of 10, as systemd-analyze rates it; below is "OK"
MACHINE = re.compile(r"^\[machines\.\w+\]$", re.MULTILINE)
needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="no systemd-analyze here"
)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, with two routers, a robot of every drive type, and the program where it is here."""
    folder = tmp_path_factory.mktemp("rendered")
    program = Path(sys.executable).with_name("snakesim")
    text = MACHINE.sub(rf'\g<0>\nprogram = "{program}"', EXAMPLE_PATH.read_text())
    text = text.replace('backend = "sim"', 'backend = "can"')
    text += '\n[routers.second]\nmachine = "hub"\nport = 7448\n'
    for name, robot in ROBOTS.items():
        text += f'\n[robots.{name}]\nmachine = "robot1"\nscenario = "triplet"\nset = ["rate_hz=50"]\n{robot}\n'
    (folder / "lab.toml").write_text(text)
    assert main(["lab", "render", str(folder / "lab.toml"), "--out", str(folder)]) == 0
    return folder


def test_zenoh_parses_every_file(rendered: Path) -> None:
    files = sorted(rendered.rglob("*.json5"))
    assert len(files) == 8 + len(ROBOTS)
    for path in files:
        settings = zenoh.Config.from_file(str(path))
        wanted = "router" if path.name.startswith("router.") else "client"
        assert settings.get_json("mode") == f'"{wanted}"', path.name
        assert '"enabled":true' not in settings.get_json("scouting").replace(" ", ""), path.name


@needs_systemd
def test_systemd_accepts_every_unit_and_finds_it_closed(rendered: Path) -> None:
    units = sorted(rendered.rglob("*.service"))
    assert len(units) == 7 + len(ROBOTS) + 6  # of programs, robots, and CAN interfaces
    done = run_program(["systemd-analyze", "verify", "--man=no", *units], rendered)
    assert done.code == 0
    assert done.err == ""
    for unit in units:
        rated = run_program(
            ["systemd-analyze", "security", "--offline=true", "--no-pager", unit], rendered
        )
        score = re.search(r"exposure level for \S+: ([\d.]+)", rated.out)
        assert score is not None and float(score[1]) <= MAX_EXPOSED, (
            f"{unit.name}: {rated.printed[-200:]}"
        )


def test_containers_run_what_the_units_run(rendered: Path) -> None:
    for compose in rendered.rglob("compose.yaml"):
        services = yaml.safe_load(compose.read_text())["services"]
        units = [
            unit.read_text() for unit in (compose.parent / "systemd").glob("snakesim-[gr]*.service")
        ]
        ours = sorted(service["command"][1:] for service in services.values())
        commands = [re.search(r"^ExecStart=\S+ (.*)$", unit, re.MULTILINE) for unit in units]
        assert ours == sorted(
            shlex.split(command[1]) for command in commands if command is not None
        )


def test_lab_files_of_removed_roles_are_deleted_others_kept(tmp_path: Path) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(EXAMPLE_PATH.read_text())
    assert main(["lab", "render", str(lab), "--out", str(tmp_path)]) == 0
    (tmp_path / "laptop" / "notes.txt").write_text("mine")
    lab.write_text(EXAMPLE_PATH.read_text().replace('role = "viewer"', 'role = "administrator"'))
    assert main(["lab", "render", str(lab), "--out", str(tmp_path)]) == 0
    left = {path.name for path in (tmp_path / "laptop").iterdir()}
    assert left == {
        "notes.txt",
        "rendered.txt",
        "operator.planar13.json5",
        "administrator.planar13.json5",
    }
