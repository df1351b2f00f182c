"""Prepares a kernel for the guest: its image, the modules that a guest needs, and a static busybox.

The files come from packages of the distribution, and are kept in `$XDG_CACHE_HOME/snakesim/vm`. Remove that folder to
download them again.
"""

import fcntl
import json
import lzma
import os
import re
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from deploy.vm import cpio
from deploy.vm.packages import (
    PreparationError,
    find_kernel_version,
    list_kernel_packages,
    require_tool,
    unpack_package,
)

# Modules that init.sh needs, then modules that a caller can request. The module files name their dependencies.
BOOT_MODULES = ("9p", "9pnet_virtio", "virtio_pci", "virtio_console", "overlay")
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
CACHE_LAYOUT = "2"
PVH_ENTRY_NOTE = 18  # type of the ELF note that marks a kernel with a PVH entry
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
    """Return the kernel in the cache, and download it first if there is none."""
    folder = find_cache_folder()
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a second run waits until the first one has downloaded
        home = next(folder.glob("[0-9]*/"), None) or _download_kernel(folder)
    modules = json.loads((home / "modules.json").read_text())
    image = next(home / name for name in ("vmlinux", "vmlinuz") if (home / name).exists())
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
    """Download a kernel into a new folder, and return it. The folder appears only when it is complete."""
    version = find_kernel_version()
    print(f"with_vcan: downloading kernel {version} into {folder} (once)", file=sys.stderr)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".download-") as scratch:
        files = Path(scratch, "files")
        prepared = Path(scratch, "prepared")
        prepared.mkdir()
        for package in (*list_kernel_packages(version), "busybox-static"):
            unpack_package(package, files)
        try:
            busybox = next(files.glob("**/bin/busybox")).read_bytes()
            image = next(files.glob("boot/vmlinuz-*")).read_bytes()
        except StopIteration:
            raise PreparationError(
                f"the packages of kernel {version} contain no kernel, or busybox-static contains no busybox"
            ) from None
        plain = extract_plain_kernel(image)
        (prepared / ("vmlinux" if plain else "vmlinuz")).write_bytes(plain or image)
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
        (prepared / "initramfs").write_bytes(_make_common_archive(busybox, modules))
        prepared.rename(folder / version)
    return folder / version


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
