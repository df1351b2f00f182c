"""Keeps a kernel ready to boot: its image, the few modules that a guest needs, and a static busybox.

They come from the distribution's packages and lie in `$XDG_CACHE_HOME/snakesim/vm`. Remove that folder to fetch again.
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
from deploy.vm.packages import PreparationError, kernel_packages, kernel_version, need_tool, unpack

# What init.sh itself needs, then what a caller can request. Their dependencies stand in the module files.
BOOT_MODULES = ("9p", "9pnet_virtio", "virtio_pci", "virtio_console", "overlay")
# The last one makes a vcan slow, in tests.
CAN_MODULES = "can", "can_raw", "can_bcm", "vcan", "sch_tbf"
INPUT_MODULES = ("uinput", "evdev")  # a virtual joystick, in tests
CONTROLLER_MODULES = ("kvaser_pci",)
NETWORK_MODULES = ("virtio_net",)

# Raise it when the contents of the cache change, so that an older one is not taken for a good one.
LAYOUT = "2"
PVH_ENTRY_NOTE = 18
XZ, ZSTD = b"\xfd7zXZ\x00", b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True)
class Kernel:
    """A kernel in the cache."""

    version: str
    image: Path
    initramfs: Path
    depends: Mapping[str, list[str]]
    built_in: list[str]


def cache_folder() -> Path:
    """Where kernels, and what was learnt about this machine, are stored."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base, "snakesim", "vm", LAYOUT)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def ready_kernel() -> Kernel:
    """The kernel in the cache; fetched first if there is none."""
    folder = cache_folder()
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # a second run waits for the first one's download
        home = next(folder.glob("[0-9]*/"), None) or _fetch(folder)
    listed = json.loads((home / "modules.json").read_text())
    image = next(home / name for name in ("vmlinux", "vmlinuz") if (home / name).exists())
    return Kernel(home.name, image, home / "initramfs", listed["depends"], listed["built_in"])


def load_order(names: Iterable[str], kernel: Kernel) -> list[str]:
    """The modules to load, every one after those that it depends on."""
    order: list[str] = []
    for name in names:
        if name in kernel.built_in:
            continue
        if name not in kernel.depends:
            raise PreparationError(f"kernel {kernel.version} has no module {name}")
        order += [
            needed
            for needed in (*load_order(kernel.depends[name], kernel), name)
            if needed not in order
        ]
    return order


def module_name(path: str) -> str:
    """`kernel/net/can/can-raw.ko.xz` is `can_raw`."""
    return Path(path).name.partition(".")[0].replace("-", "_")


def dependencies(module: bytes) -> list[str]:
    """Return the modules on which a module depends, as its section `.modinfo` lists them."""
    found = re.search(rb"\0depends=([^\0]*)\0", module)
    return found[1].decode().replace("-", "_").split(",") if found and found[1] else []


def plain_kernel(image: bytes) -> bytes | None:
    """The uncompressed kernel inside a bzImage, if QEMU can start it directly (PVH), else None.

    Under emulation the guest takes four seconds to unpack itself; here it takes one, once.
    Source: the boot protocol in the kernel's Documentation/arch/x86/boot.rst.
    """
    setup_sectors = image[0x1F1] or 4
    offset, length = struct.unpack_from("<II", image, 0x248)
    start = (setup_sectors + 1) * 512 + offset
    payload = image[start : start + length]
    if not payload.startswith((XZ, ZSTD)):
        return None
    # Four bytes at the end tell the unpacked size.
    kernel = decompressed(payload if payload.startswith(XZ) else payload[:-4])
    note = re.compile(
        struct.pack("<I", 4) + b"[\x04\x08]\0\0\0" + struct.pack("<I", PVH_ENTRY_NOTE) + b"Xen\0"
    )
    return kernel if note.search(kernel) else None


def decompressed(content: bytes) -> bytes:
    """Undo xz or zstd, if there is any."""
    if content.startswith(XZ):
        return lzma.LZMADecompressor().decompress(content)
    if content.startswith(ZSTD):
        return subprocess.run(
            [need_tool("zstd"), "-dcq"], input=content, capture_output=True, check=True
        ).stdout
    return content


def _fetch(folder: Path) -> Path:
    """Download, unpack and collect; the finished folder appears in one step."""
    version = kernel_version()
    print(f"with_vcan: fetching kernel {version} into {folder} (once)", file=sys.stderr)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".fetch-") as scratch:
        files, made = Path(scratch, "files"), Path(scratch, "made")
        made.mkdir()
        for package in (*kernel_packages(version), "busybox-static"):
            unpack(package, files)
        try:
            busybox = next(files.glob("**/bin/busybox")).read_bytes()
            image = next(files.glob("boot/vmlinuz-*")).read_bytes()
        except StopIteration:
            raise PreparationError(
                f"the packages of kernel {version} hold no kernel, or busybox-static no busybox"
            ) from None
        plain = plain_kernel(image)
        (made / ("vmlinux" if plain else "vmlinuz")).write_bytes(plain or image)
        modules = _collect({module_name(path.name): path for path in files.glob("**/*.ko*")})
        built_in = {
            module_name(line)
            for path in files.glob("**/modules.builtin")
            for line in path.read_text().split()
        }
        listed = {
            "depends": {n: dependencies(m) for n, m in modules.items()},
            "built_in": sorted(built_in),
        }
        (made / "modules.json").write_text(json.dumps(listed))
        (made / "initramfs").write_bytes(_first_files(busybox, modules))
        made.rename(folder / version)
    return folder / version


def _collect(files: Mapping[str, Path]) -> dict[str, bytes]:
    """The modules that a guest may want, with all that they depend on."""
    modules: dict[str, bytes] = {}
    waiting = [*BOOT_MODULES, *CAN_MODULES, *INPUT_MODULES, *CONTROLLER_MODULES, *NETWORK_MODULES]
    while waiting:
        name = waiting.pop()
        if name in files and name not in modules:
            modules[name] = decompressed(files[name].read_bytes())
            waiting += dependencies(modules[name])
    return modules


def _first_files(busybox: bytes, modules: Mapping[str, bytes]) -> bytes:
    """The part of the guest's first file system that is the same in every run."""
    folders = ("bin", "dev", "proc", "sys", "new", "host", "layer", "modules")
    parts = [cpio.folder(name) for name in folders]
    parts.append(cpio.file("bin/busybox", busybox, 0o755))
    parts += [cpio.file(f"modules/{name}.ko", content) for name, content in modules.items()]
    return b"".join((*parts, cpio.end()))
