"""Loads the compiled libraries, and compiles a library first if there is none of the present sources.

The choice needs no configuration: a library is used if it can be loaded, else the Python version of the same functions.
Set the environment variable SNAKESIM_NATIVE to `off` to use the Python versions, for example to compare both, or to a
folder whose libraries are to be used, for example ones with sanitizers.
"""

import ctypes
import functools
import os
from dataclasses import dataclass
from pathlib import Path

from snakesim_native.compile import SHIPPED_FOLDER, CannotCompileError, compile_library
from snakesim_native.libraries import NativeLibrary, compute_build_key, find_mujoco, make_file_name

SWITCH = "SNAKESIM_NATIVE"
OFF = "off"


@dataclass(frozen=True)
class Loaded:
    """A library, or the reason why there is none.

    Attributes:
        handle: the loaded library; None if the Python version is to be used.
        path: its file.
        problem: why there is no library; empty if there is one.
    """

    handle: ctypes.CDLL | None
    path: Path | None
    problem: str


def load(library: NativeLibrary) -> Loaded:
    """Return a library, loaded; every call in one process returns the same.

    A library that uses MuJoCo can be loaded only after MuJoCo has been imported.
    """
    return _load(library, os.environ.get(SWITCH, ""))


@functools.cache
def _load(library: NativeLibrary, switch: str) -> Loaded:
    if switch == OFF:
        return Loaded(None, None, f"the environment variable {SWITCH} is `{OFF}`")
    mujoco = find_mujoco()
    if library.uses_mujoco and mujoco is None:
        return Loaded(None, None, "MuJoCo is not installed (install the extra [sim])")
    key = compute_build_key(library, mujoco.version if mujoco else "")
    try:
        path = Path(switch, make_file_name(library, key)) if switch else _find_file(library, key)
        if path is None:
            path = _compile(library)
        handle = ctypes.CDLL(str(path))
        _check_key(handle, path, key)
    except (CannotCompileError, OSError, AttributeError) as error:
        if switch:
            raise  # a user who names a folder wants no other version
        return Loaded(None, None, str(error))
    return Loaded(handle, path, "")


def _find_file(library: NativeLibrary, key: str) -> Path | None:
    """Return the compiled file of the present sources: in this package, else in the user's cache."""
    name = make_file_name(library, key)
    for folder in (SHIPPED_FOLDER, _find_cache_folder()):
        if (folder / name).is_file():
            return folder / name
    return None


def _compile(library: NativeLibrary) -> Path:
    """Compile a library into this package, or into the user's cache if the package is read-only."""
    folder = SHIPPED_FOLDER if _is_writable(SHIPPED_FOLDER) else _find_cache_folder()
    return compile_library(library, folder)


def _is_writable(folder: Path) -> bool:
    """Return whether files can be made in a folder, which is made with them."""
    existing = folder if folder.exists() else folder.parent
    return os.access(existing, os.W_OK)


def _find_cache_folder() -> Path:
    """Return the user's folder for compiled libraries."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "snakesim", "native")


def _check_key(handle: ctypes.CDLL, path: Path, key: str) -> None:
    """Raise OSError if a library was compiled from other sources than its name stands for."""
    read_key = handle.snakesim_build_key
    read_key.restype = ctypes.c_char_p
    if read_key() != key.encode():
        raise OSError(f"{path} was compiled from other sources; remove it")
