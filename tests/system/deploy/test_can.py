"""The script and the systemd files of deploy/can configure a CAN interface in the same way."""

import configparser
import re
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[3]
CAN_FOLDER = REPOSITORY / "deploy" / "can"
UP_SCRIPT = CAN_FOLDER / "up.sh"


def run_up_script(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [UP_SCRIPT, *arguments], capture_output=True, text=True, timeout=30, check=False
    )


def read_systemd_setting(file: str, section: str, key: str) -> str:
    """Return the value of a key in a systemd file of deploy/can."""
    parser = configparser.ConfigParser()
    parser.optionxform = str  # pyright: ignore[reportAttributeAccessIssue]  # systemd's keys have capitals
    parser.read_string((CAN_FOLDER / "systemd" / file).read_text())
    return parser[section][key]


def test_up_script_help_needs_no_root_rights() -> None:
    completed = run_up_script("--help")
    assert completed.returncode == 0
    assert "1000000 bit/s" in completed.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "expected_text"),
    [
        *(
            (arguments, 2, "Usage:")
            for arguments in ((), ("eth0",), ("can0;reboot",), ("can0", "1", "2"))
        ),
        (("can0", "1M"), 1, "1M"),
    ],
)
def test_up_script_with_invalid_interface_or_bit_rate_is_refused(
    arguments: tuple[str, ...], code: int, expected_text: str
) -> None:
    completed = run_up_script(*arguments)
    assert completed.returncode == code
    assert expected_text in completed.stderr


def test_can_interface_after_bus_off_is_never_restarted() -> None:
    """The script, the systemd files, the rendered units and every command of the documentation agree."""
    assert read_systemd_setting("40-can0.network", "CAN", "RestartSec") == "0"
    commands: dict[str, str] = {}
    for page in (*(REPOSITORY / "docs").rglob("*.md"), *(REPOSITORY / "deploy").rglob("*.md")):
        commands[page.name] = "".join(
            re.findall(r"^```\w*\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
        )
    for file in (
        UP_SCRIPT,
        REPOSITORY / "snakesim_operator" / "features" / "lab" / "templates" / "can.j2",
    ):
        commands[file.name] = file.read_text()
    restart_ms_by_file = {
        name: set(re.findall(r"restart-ms\W+(\d+)", text)) for name, text in commands.items()
    }
    assert {name for name, values in restart_ms_by_file.items() if values} >= {
        "up.sh",
        "can.j2",
        "moteus.md",
    }
    assert set().union(*restart_ms_by_file.values()) == {"0"}, restart_ms_by_file


def test_up_script_and_systemd_set_same_rate_and_queue() -> None:
    assert read_systemd_setting("40-can0.network", "CAN", "BitRate") == "1M"
    assert "\nbitrate=1000000\n" in UP_SCRIPT.read_text()
    assert (
        f"\nqueue={read_systemd_setting('40-can.link', 'Link', 'TransmitQueueLength')} "
        in UP_SCRIPT.read_text()
    )
