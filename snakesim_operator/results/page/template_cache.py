"""Keeps compiled templates in `__pycache__`, as Python keeps compiled modules. Compiling a report takes 0.15 s."""

import hashlib
import importlib.util
import os
import pickle
import sys
from contextlib import suppress
from pathlib import Path

import jinja2
import jinja2.compiler
from jinja2.bccache import Bucket


class TemplateCache(jinja2.BytecodeCache):
    """Loads compiled templates from the folder in which Python keeps the modules beside them.

    A folder that cannot be written, such as that of another user, is left as it is: the template is compiled again.
    """

    def __init__(self, options: str) -> None:
        """Create a cache.

        Args:
            options: Text that changes with the options of the environment, which change the compiled code.
        """
        compiler = Path(jinja2.compiler.__file__).stat()  # differs after an update of Jinja
        self._salt = f"{compiler.st_mtime_ns} {compiler.st_size} {options}".encode()

    def get_cache_key(self, name: str, filename: str | None = None) -> str:
        """Return the path of the compiled template."""
        return importlib.util.cache_from_source(f"{filename or name}.py")

    def get_source_checksum(self, source: str) -> str:
        """Return a checksum of all that the compiled code depends on."""
        return hashlib.sha256(self._salt + source.encode()).hexdigest()

    def load_bytecode(self, bucket: Bucket) -> None:
        """Load the compiled template, if there is one of the same source."""
        damaged = (EOFError, ValueError, TypeError, pickle.UnpicklingError)
        with suppress(OSError, *damaged), Path(bucket.key).open("rb") as file:
            bucket.load_bytecode(file)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Write the compiled template, whole or not at all: other processes may read it at the same time."""
        if sys.dont_write_bytecode:
            return
        path = Path(bucket.key)
        written = path.with_suffix(f".{os.getpid()}")
        with suppress(OSError):
            path.parent.mkdir(exist_ok=True)
            written.write_bytes(bucket.bytecode_to_string())
            written.replace(path)
