"""Entry point of the `snakesim` command."""

import errno
import os
import sys


def _remove_working_folder_from_search_path() -> None:
    """Remove the working folder from the module search path, so that its files replace no module imported below."""
    if __name__ == "__main__" and not sys.flags.safe_path:
        del sys.path[0]  # `python -m` has put that folder there
    search_path = os.environ.get("PYTHONPATH", "")
    if search_path and "" in search_path.split(
        os.pathsep
    ):  # as in PYTHONPATH=/opt/mine:$PYTHONPATH
        try:
            folder = os.getcwd()  # noqa: PTH109 - pathlib itself could be replaced
        except FileNotFoundError:  # it has been deleted
            return
        sys.path.sort(key=folder.__eq__)  # to the end: Python looks there last


_remove_working_folder_from_search_path()

import resource  # noqa: E402
import signal  # noqa: E402

from snakesim_hal.base.arithmetic import pin_common_arithmetic  # noqa: E402
from snakesim_hal.base.process import (  # noqa: E402
    isolate_children_from_working_folder,
    make_collections_rare,
)
from snakesim_hal.base.terminal import print_stderr  # noqa: E402


def main() -> int:
    """Run a command, and return its exit code.

    Ctrl-C ends a command at once, by the signal itself, also during import and exit, where
    Python would print a traceback. `snakesim run` and `snakesim drive emulate can`, which must shut
    down in order, handle the signal themselves.
    """
    _open_closed_streams()
    make_collections_rare()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not if the shell ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    isolate_children_from_working_folder()
    pin_common_arithmetic(one_thread=True)  # before NumPy is imported
    try:
        from snakesim_operator.cli import main as command

        return command()
    except (MemoryError, ImportError, SystemError, OSError) as error:
        if not _is_out_of_memory(error):
            raise
        print_stderr(f"snakesim: this command needs more memory than {_describe_memory_limit()}")
        return 1


def _open_closed_streams() -> None:
    """Connect each standard stream that the caller has closed, as by `>&-`, to /dev/null.

    Otherwise the next file that is opened gets the stream's number.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            mode = "r" if number == 0 else "w"
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether an error was caused by a lack of memory.

    With a limited address space, a library that cannot be mapped may raise an ImportError or a SystemError.
    """
    if isinstance(error, MemoryError):
        return True
    is_limited = resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY
    if isinstance(error, OSError) and error.errno != errno.ENOMEM:
        return False
    return is_limited


def _describe_memory_limit() -> str:
    """Return what limits the memory of this process."""
    limit_bytes = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit_bytes == resource.RLIM_INFINITY:
        return "this computer has"
    return f"`ulimit -v` allows, {limit_bytes // 2**20} MB"


if __name__ == "__main__":
    sys.exit(main())
