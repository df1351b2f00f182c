"""deploy/can: the script's manners, and that script and systemd files say the same."""

import configparser
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
CAN = ROOT / "deploy" / "can"
UP = CAN / "up.sh"


def up(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([UP, *arguments], capture_output=True, text=True, timeout=30, check=False)


def setting(file: str, section: str, key: str) -> str:
    parser = configparser.ConfigParser()
    parser.optionxform = str  # pyright: ignore[reportAttributeAccessIssue]  # systemd's keys have capitals
    parser.read_string((CAN / "systemd" / file).read_text())
    return parser[section][key]


def test_help_needs_no_rights() -> None:
    done = up("--help")
    assert done.returncode == 0
    assert "1000000 bit/s" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        *((given, 2, "Usage:") for given in ((), ("eth0",), ("can0;reboot",), ("can0", "1", "2"))),
        (("can0", "1M"), 1, "1M"),
    ],
)
def test_what_is_no_can_interface_or_bit_rate_is_refused(
    arguments: tuple[str, ...], code: int, words: str
) -> None:
    done = up(*arguments)
    assert done.returncode == code
    assert words in done.stderr


def test_bus_off_stays_off_wherever_an_interface_is_configured() -> None:
    """In script, systemd files, rendered units and every command of the documentation."""
    assert setting("40-can0.network", "CAN", "RestartSec") == "0"
    commands: dict[str, str] = {}
    for page in (*(ROOT / "docs").rglob("*.md"), *(ROOT / "deploy").rglob("*.md")):
        commands[page.name] = "".join(
            re.findall(r"^```\w*\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
        )
    for file in (UP, ROOT / "snakesim_operator" / "features" / "lab" / "templates" / "can.j2"):
        commands[file.name] = file.read_text()
    found = {name: set(re.findall(r"restart-ms\W+(\d+)", text)) for name, text in commands.items()}
    assert {name for name, values in found.items() if values} >= {"up.sh", "can.j2", "moteus.md"}
    assert set().union(*found.values()) == {"0"}, found


def test_script_and_systemd_set_the_same_rate_and_queue() -> None:
    assert setting("40-can0.network", "CAN", "BitRate") == "1M"
    assert "\nbitrate=1000000\n" in UP.read_text()
    assert f"\nqueue={setting('40-can.link', 'Link', 'TransmitQueueLength')} " in UP.read_text()
