"""Installs tools for the virtual machine with apt, and downloads and unpacks other packages without installing them."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

PACKAGES_BY_TOOL = {"qemu-system-x86_64": "qemu-system-x86", "ip": "iproute2"}
# The kernel packages of Debian and Ubuntu. Their kernels for the cloud have no CAN.
KERNEL_PACKAGES = ("linux-image-amd64", "linux-image-generic")
USER_MODE_PACKAGE = "user-mode-linux"
PACKAGE_LISTS = Path("/var/lib/apt/lists")
APT_TIMEOUT_S = 900
MAX_MESSAGE_CHARACTERS = 2000


class PreparationError(RuntimeError):
    """Raised if something that the guest needs is missing. The message explains what to do."""


def find_tool(name: str) -> str | None:
    """Return the path of a tool, or None. Folders that the PATH of a user often leaves out are searched, too."""
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin:/usr/bin:/bin")


def require_tool(name: str) -> str:
    """Return the path of a tool. If it is missing, install it as root.

    Raises:
        PreparationError: The tool is missing, and cannot be installed.
    """
    if path := find_tool(name):
        return path
    install = [
        "apt-get",
        "install",
        "--yes",
        "--no-install-recommends",
        PACKAGES_BY_TOOL.get(name, name),
    ]
    if os.geteuid() != 0:
        raise PreparationError(
            f"{name} is missing. Run: sudo apt-get update && sudo {' '.join(install)}"
        )
    print(f"with_vcan: installing {install[-1]}", file=sys.stderr)
    if _run_apt(install).returncode:
        update_lists()
        _check_success(_run_apt(install))
    if path := find_tool(name):
        return path
    raise PreparationError(f"{install[-1]} is installed, but {name} is not on the PATH")


def update_lists() -> None:
    """Update the package lists, as root.

    Raises:
        PreparationError: The user is not root, or the update fails.
    """
    if os.geteuid() != 0:
        raise PreparationError("the package lists are missing or too old. Run: sudo apt-get update")
    _check_success(_run_apt(["apt-get", "update"]))


def find_kernel_version() -> str:
    """Return the version of the distribution's current kernel, as in the names of its packages.

    Raises:
        PreparationError: The distribution has no such package, even after an update of the package lists.
    """
    for update_first in (False, True):
        if update_first:
            update_lists()
        for package in KERNEL_PACKAGES:
            dependencies = _run_apt(["apt-cache", "depends", package]).stdout
            match = re.search(r"Depends: linux-image-(\d\S*)", dependencies)
            if match is not None:
                return match[1]
    raise PreparationError(
        f"apt has no package {' or '.join(KERNEL_PACKAGES)}: the guest needs Debian or Ubuntu on x86-64"
    )


def find_user_mode_version() -> str:
    """Return the version of the distribution's package of user-mode Linux.

    Raises:
        PreparationError: The distribution has no such package.
    """
    if not any(PACKAGE_LISTS.glob("*Packages*")):
        update_lists()
    policy = _run_apt(["apt-cache", "policy", USER_MODE_PACKAGE]).stdout
    match = re.search(r"Candidate: (\d\S*)", policy)
    if match is None:
        raise PreparationError(f"apt has no package {USER_MODE_PACKAGE}")
    return match[1]


def list_kernel_packages(version: str) -> list[str]:
    """Return the packages that contain image and modules of a kernel. Ubuntu has several of them."""
    names = (f"linux-{part}-{version}" for part in ("image", "modules", "modules-extra"))
    return [name for name in names if _run_apt(["apt-cache", "show", name]).returncode == 0]


def unpack_package(package: str, into: Path) -> None:
    """Download a package, and unpack its files below `into`. The package is not installed."""
    downloads = into.parent / "downloads"
    downloads.mkdir(exist_ok=True)
    # If root calls apt, it downloads as another user, who may not write here.
    options = ["-o", "APT::Sandbox::User=root"] if os.geteuid() == 0 else []
    download = ["apt-get", *options, "download", package]
    if _run_apt(download, downloads).returncode:
        update_lists()
        _check_success(_run_apt(download, downloads))
    for archive in downloads.glob(f"{package}_*.deb"):
        _check_success(_run_apt(["dpkg-deb", "--extract", str(archive), str(into)]))


def _run_apt(command: list[str], folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a program of apt or dpkg without input, and return its result."""
    if not shutil.which(command[0]):
        raise PreparationError(
            f"{command[0]} is missing: the guest needs Debian or Ubuntu on x86-64"
        )
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C"}
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=APT_TIMEOUT_S,
        check=False,
    )


def _check_success(completed: subprocess.CompletedProcess[str]) -> None:
    """Raise PreparationError with the last messages of a program if it failed."""
    if completed.returncode:
        messages = completed.stderr.strip()[-MAX_MESSAGE_CHARACTERS:]
        raise PreparationError(f"`{' '.join(completed.args)}` failed:\n{messages}")
