"""Loads the compiled libraries, and compiles a library first if there is none of the current sources.

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

SWITCH_VARIABLE = "SNAKESIM_NATIVE"
SWITCH_OFF = "off"


@dataclass(frozen=True)
class LoadedLibrary:
    """A library, or the reason why there is none.

    Attributes:
        library: The loaded library; None if the Python version is to be used.
        path: File of the loaded library; None if there is none.
        problem: Why no library is loaded; an empty text if one is.
    """

    library: ctypes.CDLL | None
    path: Path | None
    problem: str


def load_shared_library(library: NativeLibrary) -> LoadedLibrary:
    """Load a library, compiling it first if necessary; every call in one process returns the same object.

    A library that uses MuJoCo can be loaded only after MuJoCo has been imported.
    """
    return _load_cached(library, os.environ.get(SWITCH_VARIABLE, ""))


@functools.cache
def _load_cached(library: NativeLibrary, setting: str) -> LoadedLibrary:
    """Load a library as `load_shared_library` does, once for each value of the environment variable.

    Args:
        library: The library.
        setting: Value of the environment variable: `off` for the Python versions, the path of a folder with compiled
            libraries, or empty to use or compile a library of the current sources.

    Returns:
        The library, or the reason why there is none.

    Raises:
        OSError: The library of the named folder cannot be loaded.
        AttributeError: The library of the named folder has no build key.
    """
    if setting == SWITCH_OFF:
        return LoadedLibrary(
            library=None,
            path=None,
            problem=f"the environment variable {SWITCH_VARIABLE} is `{SWITCH_OFF}`",
        )
    mujoco = find_mujoco()
    if library.uses_mujoco and mujoco is None:
        return LoadedLibrary(
            library=None, path=None, problem="MuJoCo is not installed (install the extra [sim])"
        )
    key = compute_build_key(library, mujoco.version if mujoco else "")
    try:
        path = (
            Path(setting, make_file_name(library, key))
            if setting
            else _find_compiled_file(library, key)
        )
        if path is None:
            path = _compile_to_writable_folder(library)
        handle = ctypes.CDLL(str(path))
        _check_build_key(handle, path, key)
    except (CannotCompileError, OSError, AttributeError) as error:
        if setting:
            raise  # an explicitly named library must not fall back silently to the Python version
        return LoadedLibrary(library=None, path=None, problem=str(error))
    return LoadedLibrary(handle, path, "")


def _find_compiled_file(library: NativeLibrary, key: str) -> Path | None:
    """Return the compiled file of the current sources: in this package, else in the user's cache."""
    name = make_file_name(library, key)
    for folder in (SHIPPED_FOLDER, _get_cache_folder()):
        if (folder / name).is_file():
            return folder / name
    return None


def _compile_to_writable_folder(library: NativeLibrary) -> Path:
    """Compile a library into this package, or into the user's cache if the package is read-only."""
    return compile_library(library, choose_writable_folder())


def choose_writable_folder() -> Path:
    """Return the folder for what is compiled here: in this package, or the user's cache if the package is read-only."""
    return SHIPPED_FOLDER if _is_writable(SHIPPED_FOLDER) else _get_cache_folder()


def _is_writable(folder: Path) -> bool:
    """Return whether files can be made in a folder, which is made with them."""
    existing = folder if folder.exists() else folder.parent
    return os.access(existing, os.W_OK)


def _get_cache_folder() -> Path:
    """Return the user's folder for compiled libraries."""
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(cache, "snakesim", "native")


def _check_build_key(handle: ctypes.CDLL, path: Path, key: str) -> None:
    """Raise OSError if a library was compiled from other sources than its name stands for."""
    get_build_key = handle.snakesim_build_key
    get_build_key.restype = ctypes.c_char_p
    if get_build_key() != key.encode():
        raise OSError(f"{path} was compiled from other sources; remove it")
