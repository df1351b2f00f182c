"""deploy/can: the script's manners, and that script and systemd files say the same."""

import configparser
import subprocess
from pathlib import Path

import pytest

CAN = Path(__file__).parents[3] / "deploy" / "can"
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


@pytest.mark.parametrize("arguments", [(), ("eth0",), ("can0;reboot",), ("can0", "1", "2")])
def test_what_is_no_can_interface_gets_the_usage(arguments: tuple[str, ...]) -> None:
    done = up(*arguments)
    assert done.returncode == 2
    assert "Usage:" in done.stderr


def test_a_bit_rate_that_is_no_number_is_refused() -> None:
    done = up("can0", "1M")
    assert done.returncode == 1
    assert "1M" in done.stderr


def test_bus_off_stays_off_in_both() -> None:
    assert setting("40-can0.network", "CAN", "RestartSec") == "0"
    assert "restart-ms 0" in UP.read_text()


def test_script_and_systemd_set_the_same_rate_and_queue() -> None:
    assert setting("40-can0.network", "CAN", "BitRate") == "1M"
    assert "\nbitrate=1000000\n" in UP.read_text()
    assert f"\nqueue={setting('40-can.link', 'Link', 'TransmitQueueLength')} " in UP.read_text()
