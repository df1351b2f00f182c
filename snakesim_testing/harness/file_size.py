"""Simulates a full disk by a limit on the size of files."""

import resource
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def limited_file_size(size_bytes: int) -> Iterator[None]:
    """Limit the size of all files that this process and its children write within the context.

    Python does not write bytecode meanwhile: Python 3.11 does not notice if only a part of it could be written, and
    every later process that imports the module would fail.

    Args:
        size_bytes: Maximum size of a file in bytes. Writing beyond it fails with EFBIG.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "dont_write_bytecode", True)
        patched.setenv("PYTHONDONTWRITEBYTECODE", "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, ignored)
