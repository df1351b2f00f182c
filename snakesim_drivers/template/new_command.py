"""Runs `snakesim drive new`."""

import keyword
import re
import sys
from pathlib import Path

from snakesim_drivers.template.package_files import make_package_files
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.plugins import BACKENDS, list_installed_plugins
from snakesim_hal.model.textfiles import write_text

MAX_NAME_LENGTH = 40  # characters
NAME_PATTERN = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")


def write_driver_package(name: str, folder: Path | None) -> int:
    """Write a package with a new driver type, and print what to do next.

    Args:
        name: Name of the driver type.
        folder: Folder to write into, which must not exist; None for a folder with the name of the driver type.

    Returns:
        Exit code 0.

    Raises:
        ConfigError: The name is not possible, or the folder exists.
    """
    validate_driver_name(name)
    folder = folder or Path(name)
    if folder.exists() or folder.is_symlink():
        raise ConfigError(
            f"{folder} exists already, and nothing was written: give another folder, `--out PATH`, or remove it",
            code="file/already-exists",
        )
    files = make_package_files(name)
    for path, text in files.items():
        write_text(folder / path, text)
        print_line(f"wrote {folder / path}")
    print_line("")
    print_line("It passes the contract suite as it is, on emulated drives. Run it:")
    print_line(f"  cd {folder} && {sys.executable} -m pytest")
    print_line(
        f"Then replace the protocol in {folder / name}_driver/driver.py by that of your drives."
    )
    return 0


def validate_driver_name(name: str) -> None:
    """Check that a name is possible for a new driver type.

    Raises:
        ConfigError: The name is malformed or too long, a keyword of Python, or that of an installed backend.
    """
    if not NAME_PATTERN.fullmatch(name) or len(name) > MAX_NAME_LENGTH:
        raise ConfigError(
            f"the name {name[:60]!r} is not possible: give lower-case letters, digits and single underscores, a letter "
            f"first, at most {MAX_NAME_LENGTH} characters, such as `acme_servo`",
            code="config/invalid-value",
        )
    if keyword.iskeyword(name):
        raise ConfigError(
            f"{name!r} is a word of Python; give another name, such as `{name}_drive`",
            code="config/invalid-value",
        )
    if name in list_installed_plugins(BACKENDS):
        raise ConfigError(
            f"a backend {name!r} is installed already; give another name, such as `my_{name}`",
            code="config/duplicate-name",
        )
