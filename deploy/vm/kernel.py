"""Prepares a kernel for the guest: its image, the modules that a guest needs, and a static busybox.

There are two kernels: that of the distribution, which QEMU boots, and user-mode Linux, a kernel that is a program. The
files come from packages of the distribution, and are kept in `$XDG_CACHE_HOME/snakesim/vm`. Remove that folder to
download them again.
"""

import fcntl
import json
import lzma
import os
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from deploy.vm import cpio
from deploy.vm.packages import (
    USER_MODE_PACKAGE,
    PreparationError,
    find_kernel_version,
    find_user_mode_version,
    list_kernel_packages,
    require_tool,
    unpack_package,
)

# Modules that init.sh needs, then modules that a caller can request. The module files name their dependencies.
BOOT_MODULES = ("9p", "9pnet_virtio", "virtio_pci", "virtio_console", "overlay")
USER_MODE_BOOT_MODULES = ("overlay",)
CAN_MODULES = (
    "can",
    "can_raw",
    "can_bcm",
    "vcan",
    "sch_tbf",
)  # the last one makes a vcan slow, in tests
INPUT_MODULES = ("uinput", "evdev")  # for a virtual joystick, in tests
CONTROLLER_MODULES = ("kvaser_pci",)
NETWORK_MODULES = ("virtio_net",)

# Increase this number if the contents of the cache change, so that an older cache is not used.
CACHE_LAYOUT = "3"
PVH_ENTRY_NOTE = 18  # type of the ELF note that marks a kernel with a PVH entry
# Names of the image in the cache: uncompressed, compressed, and the program of user-mode Linux.
IMAGE_NAMES = ("vmlinux", "vmlinuz", "linux.uml")
# First bytes of compressed data.
XZ_MAGIC = b"\xfd7zXZ\x00"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class Kernel:
    """A kernel in the cache."""

    version: str
    image: Path
    initramfs: Path
    depends: Mapping[str, list[str]]  # modules on which each module depends
    built_in: list[str]  # modules that the image contains


def find_cache_folder() -> Path:
    """Return the folder for kernels and for the result of the KVM test. It is created if it is missing."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base, "snakesim", "vm", CACHE_LAYOUT)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def prepare_kernel() -> Kernel:
    """Return the distribution's kernel from the cache, and download it first if it is not there."""
    return _prepare("distribution", _download_kernel)


def prepare_user_mode_kernel() -> Kernel:
    """Return user-mode Linux from the cache, and download it first if it is not there."""
    return _prepare("user-mode", _download_user_mode_kernel)


def _prepare(name: str, download: Callable[[Path], Path]) -> Kernel:
    """Return a kernel from its folder in the cache.

    Args:
        name: Name of the folder.
        download: Downloads the kernel into a new folder in that folder, and returns the new one.
    """
    folder = find_cache_folder() / name
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a second run waits until the first one has downloaded
        home = next(folder.glob("[0-9]*/"), None) or download(folder)
    modules = json.loads((home / "modules.json").read_text())
    image = next(path for file in IMAGE_NAMES if (path := home / file).exists())
    return Kernel(home.name, image, home / "initramfs", modules["depends"], modules["built_in"])


def order_modules(names: Iterable[str], kernel: Kernel) -> list[str]:
    """Return the modules to load, each after the modules on which it depends.

    Raises:
        PreparationError: The kernel does not have one of the modules.
    """
    order: list[str] = []
    for name in names:
        if name in kernel.built_in:
            continue
        if name not in kernel.depends:
            raise PreparationError(f"kernel {kernel.version} has no module {name}")
        for module in (*order_modules(kernel.depends[name], kernel), name):
            if module not in order:
                order.append(module)
    return order


def parse_module_name(path: str) -> str:
    """Return the name of the module in a file: `can_raw` for `kernel/net/can/can-raw.ko.xz`."""
    return Path(path).name.partition(".")[0].replace("-", "_")


def find_dependencies(module: bytes) -> list[str]:
    """Return the modules on which a module depends, as its section `.modinfo` lists them."""
    entry = re.search(rb"\0depends=([^\0]*)\0", module)
    if entry is None or not entry[1]:
        return []
    return entry[1].decode().replace("-", "_").split(",")


def extract_plain_kernel(image: bytes) -> bytes | None:
    """Return the uncompressed kernel inside a bzImage, or None if QEMU cannot start it directly (PVH).

    An emulated guest needs four seconds to unpack the kernel at each start. Here it takes one second, once.
    Source: the boot protocol in the kernel's Documentation/arch/x86/boot.rst.
    """
    setup_sectors = image[0x1F1] or 4
    offset, length = struct.unpack_from("<II", image, 0x248)
    start = (setup_sectors + 1) * 512 + offset
    payload = image[start : start + length]
    if not payload.startswith((XZ_MAGIC, ZSTD_MAGIC)):
        return None
    # The last four bytes are the unpacked size.
    # The decompressor of xz ignores them.
    kernel = decompress(payload if payload.startswith(XZ_MAGIC) else payload[:-4])
    note = re.compile(
        struct.pack("<I", 4) + b"[\x04\x08]\0\0\0" + struct.pack("<I", PVH_ENTRY_NOTE) + b"Xen\0"
    )
    return kernel if note.search(kernel) else None


def decompress(content: bytes) -> bytes:
    """Return decompressed content. Content that is compressed with neither xz nor zstd is returned as it is."""
    if content.startswith(XZ_MAGIC):
        return lzma.LZMADecompressor().decompress(content)
    if content.startswith(ZSTD_MAGIC):
        return subprocess.run(
            [require_tool("zstd"), "-dcq"], input=content, capture_output=True, check=True
        ).stdout
    return content


def _download_kernel(folder: Path) -> Path:
    """Download the distribution's kernel into a new folder, and return that folder."""
    version = find_kernel_version()
    with _unpacked_packages(folder, version, list_kernel_packages(version)) as (files, prepared):
        image = _find_file(files, "boot/vmlinuz-*").read_bytes()
        plain = extract_plain_kernel(image)
        (prepared / ("vmlinux" if plain else "vmlinuz")).write_bytes(plain or image)
        _store_modules(files, prepared)
    return folder / version


def _download_user_mode_kernel(folder: Path) -> Path:
    """Download user-mode Linux into a new folder, and return that folder."""
    version = find_user_mode_version()
    with _unpacked_packages(folder, version, [USER_MODE_PACKAGE]) as (files, prepared):
        shutil.copy(_find_file(files, "**/bin/linux.uml"), prepared / "linux.uml")
        _store_modules(files, prepared)
    return folder / version


@contextmanager
def _unpacked_packages(
    folder: Path, version: str, packages: Iterable[str]
) -> Iterator[tuple[Path, Path]]:
    """Unpack packages and busybox, and let the caller prepare the kernel that they contain.

    Args:
        folder: Folder of this kind of kernel in the cache.
        version: Version of the kernel. The prepared files appear in a folder of this name, all at once.
        packages: The packages to download.

    Yields:
        The folder of the unpacked files, and the folder in which the caller puts the prepared files.
    """
    print(f"with_vcan: downloading kernel {version} into {folder} (once)", file=sys.stderr)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".download-") as scratch:
        files = Path(scratch, "files")
        prepared = Path(scratch, "prepared")
        prepared.mkdir()
        for package in (*packages, "busybox-static"):
            unpack_package(package, files)
        yield files, prepared
        prepared.rename(folder / version)


def _find_file(files: Path, pattern: str) -> Path:
    """Return the file of the unpacked packages that a pattern matches."""
    path = next(files.glob(pattern), None)
    if path is None:
        raise PreparationError(f"the downloaded packages contain no file {pattern}")
    return path


def _store_modules(files: Path, prepared: Path) -> None:
    """Store the modules that a guest can load, a list of their dependencies, and the first file system."""
    modules = _collect_modules(
        {parse_module_name(path.name): path for path in files.glob("**/*.ko*")}
    )
    built_in = {
        parse_module_name(line)
        for path in files.glob("**/modules.builtin")
        for line in path.read_text().split()
    }
    depends = {name: find_dependencies(module) for name, module in modules.items()}
    listing = {"depends": depends, "built_in": sorted(built_in)}
    (prepared / "modules.json").write_text(json.dumps(listing))
    busybox = _find_file(files, "**/bin/busybox").read_bytes()
    (prepared / "initramfs").write_bytes(_make_common_archive(busybox, modules))


def _collect_modules(files: Mapping[str, Path]) -> dict[str, bytes]:
    """Return the content of all modules that a guest can load, with those on which they depend.

    Args:
        files: Paths of all modules of the kernel, by module name.
    """
    modules: dict[str, bytes] = {}
    pending = [*BOOT_MODULES, *CAN_MODULES, *INPUT_MODULES, *CONTROLLER_MODULES, *NETWORK_MODULES]
    while pending:
        name = pending.pop()
        if name in files and name not in modules:
            modules[name] = decompress(files[name].read_bytes())
            pending += find_dependencies(modules[name])
    return modules


def _make_common_archive(busybox: bytes, modules: Mapping[str, bytes]) -> bytes:
    """Return the part of the guest's first file system that is the same in every run, as a cpio archive."""
    folders = ("bin", "dev", "proc", "sys", "new", "host", "layer", "modules")
    parts = [cpio.make_folder_entry(name) for name in folders]
    parts.append(cpio.make_file_entry("bin/busybox", busybox, 0o755))
    parts += [
        cpio.make_file_entry(f"modules/{name}.ko", content) for name, content in modules.items()
    ]
    return b"".join((*parts, cpio.make_end_entry()))
