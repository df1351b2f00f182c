"""Gets what the VM needs from the distribution: tools are installed, everything else only downloaded and unpacked."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

TOOLS = {"qemu-system-x86_64": "qemu-system-x86", "ip": "iproute2"}
# Debian's and Ubuntu's; the cloud images have no CAN.
KERNEL_PACKAGES = "linux-image-amd64", "linux-image-generic"
APT_LIMIT_S = 900


class PreparationError(RuntimeError):
    """Something that the guest needs is missing; the message explains what to do."""


def find_tool(name: str) -> str | None:
    """The tool's path, searched also in the folders that a user's PATH leaves out."""
    return shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin:/usr/bin:/bin")


def need_tool(name: str) -> str:
    """The tool's path; installed first if it is missing and we are root."""
    if found := find_tool(name):
        return found
    install = ["apt-get", "install", "--yes", "--no-install-recommends", TOOLS.get(name, name)]
    if os.geteuid() != 0:
        raise PreparationError(
            f"{name} is missing. Run: sudo apt-get update && sudo {' '.join(install)}"
        )
    print(f"with_vcan: installing {install[-1]}", file=sys.stderr)
    if _apt(install).returncode:
        update_lists()
        _must(_apt(install))
    if found := find_tool(name):
        return found
    raise PreparationError(f"{install[-1]} is installed and still there is no {name} on the PATH")


def update_lists() -> None:
    """`apt-get update`, for which one must be root."""
    if os.geteuid() != 0:
        raise PreparationError("the package lists are missing or too old. Run: sudo apt-get update")
    _must(_apt(["apt-get", "update"]))


def kernel_version() -> str:
    """The version of the distribution's current kernel, as its package is named."""
    for update in (False, True):
        if update:
            update_lists()
        for package in KERNEL_PACKAGES:
            listed = _apt(["apt-cache", "depends", package]).stdout
            if found := re.search(r"Depends: linux-image-(\d\S*)", listed):
                return found[1]
    raise PreparationError(
        f"apt knows none of {', '.join(KERNEL_PACKAGES)}: only Debian and Ubuntu on x86-64 will do"
    )


def kernel_packages(version: str) -> list[str]:
    """The packages that together hold the image and the modules (Ubuntu splits them)."""
    names = (f"linux-{part}-{version}" for part in ("image", "modules", "modules-extra"))
    return [name for name in names if _apt(["apt-cache", "show", name]).returncode == 0]


def unpack(package: str, into: Path) -> None:
    """Download a package and lay its files out below `into`; nothing is installed."""
    downloads = into.parent / "downloads"
    downloads.mkdir(exist_ok=True)
    # As root apt drops to a user of its own, who may not write here.
    options = ["-o", "APT::Sandbox::User=root"] if os.geteuid() == 0 else []
    download = ["apt-get", *options, "download", package]
    if _apt(download, downloads).returncode:
        update_lists()
        _must(_apt(download, downloads))
    for archive in downloads.glob(f"{package}_*.deb"):
        _must(_apt(["dpkg-deb", "--extract", str(archive), str(into)]))


def _apt(command: list[str], folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    if not shutil.which(command[0]):
        raise PreparationError(f"{command[0]} is missing: only Debian and Ubuntu on x86-64 will do")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C"}
    return subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=APT_LIMIT_S,
        check=False,
    )


def _must(done: subprocess.CompletedProcess[str]) -> None:
    if done.returncode:
        raise PreparationError(f"`{' '.join(done.args)}` failed:\n{done.stderr.strip()[-2000:]}")
