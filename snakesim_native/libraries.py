"""The libraries of this package, their sources, and where MuJoCo's headers are."""

import hashlib
import importlib.util
import platform
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
SHARED_SOURCE = PACKAGE / "build_key.c"  # is compiled into every library

# No multiplication and addition is fused, so that every processor and compiler computes the same bits.
FLAGS = (
    "-std=c11",
    "-O2",
    "-ffp-contract=off",
    "-fPIC",
    "-shared",
    "-Wall",
    "-Wextra",
    "-Werror=vla",
)
KEY_LENGTH = 12  # characters of the hash in a file's name


@dataclass(frozen=True, kw_only=True)
class NativeLibrary:
    """One shared library: all C files of one folder of this package."""

    name: str  # of the folder
    uses_mujoco: bool
    python_cost: str  # a clause about what the Python version costs, for messages

    @property
    def folder(self) -> Path:
        """Return the folder with the sources."""
        return PACKAGE / self.name

    def list_sources(self) -> list[Path]:
        """Return the C files, in the order of their names."""
        return [SHARED_SOURCE, *sorted(self.folder.glob("*.c"))]

    def list_headers(self) -> list[Path]:
        """Return the header files, in the order of their names."""
        return sorted(self.folder.glob("*.h"))


LAWS_LIBRARY = NativeLibrary(
    name="laws",
    uses_mujoco=True,
    python_cost="a physics step takes about three times as long",
)
PLANNER_LIBRARY = NativeLibrary(
    name="planner",
    uses_mujoco=False,
    python_cost="a search of the path planner takes about seven times as long",
)
LIBRARIES = (LAWS_LIBRARY, PLANNER_LIBRARY)


@dataclass(frozen=True)
class MujocoFiles:
    """The files of an installed MuJoCo that a library is compiled with."""

    include_folder: Path
    library: Path  # libmujoco.so.VERSION

    @property
    def version(self) -> str:
        """Return for example "4.0.1"."""
        return self.library.name.partition(".so.")[2]


def find_mujoco() -> MujocoFiles | None:
    """Return the files of the installed MuJoCo, without importing it; None if it is not installed."""
    spec = importlib.util.find_spec("mujoco")
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(spec.submodule_search_locations[0])
    libraries = sorted(folder.glob("libmujoco.so.*"))
    if not libraries:
        return None
    return MujocoFiles(folder / "include", libraries[-1])


def compute_build_key(library: NativeLibrary, mujoco_version: str) -> str:
    """Return a hash of everything that decides what a library does: sources, flags and MuJoCo's version."""
    digest = hashlib.sha256(" ".join(FLAGS).encode())
    if library.uses_mujoco:
        digest.update(mujoco_version.encode())
    for file in (*library.list_sources(), *library.list_headers()):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:KEY_LENGTH]


def make_file_name(library: NativeLibrary, key: str, machine: str = "") -> str:
    """Return the file name of a compiled library. Files of other sources, versions or processors have other names.

    Args:
        library: The library.
        key: Build key of the library.
        machine: Processor architecture as `uname -m` prints it; empty for that of this computer.
    """
    return f"{library.name}-{machine or platform.machine()}-{key}.so"
