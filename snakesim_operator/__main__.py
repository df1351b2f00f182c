"""Entry point of the `snakesim` command."""

import errno
import os
import sys


def _leave_out_working_folder() -> None:
    """Keep files in the working folder from replacing the modules that are imported below."""
    if __name__ == "__main__" and not sys.flags.safe_path:
        del sys.path[0]  # `python -m` has put that folder there
    search_path = os.environ.get("PYTHONPATH", "")
    if search_path and "" in search_path.split(os.pathsep):  # as in PYTHONPATH=/opt/mine:$PYTHONPATH
        try:
            folder = os.getcwd()  # noqa: PTH109 - pathlib itself could be replaced
        except FileNotFoundError:  # it has been deleted
            return
        sys.path.sort(key=folder.__eq__)  # to the end: Python looks there last


_leave_out_working_folder()

import resource  # noqa: E402
import signal  # noqa: E402

from snakesim_hal.base.arithmetic import pin  # noqa: E402
from snakesim_hal.base.process import protect_children  # noqa: E402
from snakesim_hal.base.terminal import print_stderr  # noqa: E402


def main() -> int:
    """The command's exit code.

    Ctrl-C ends a command at once, by the signal itself, also during import and exit, where
    Python would print a traceback. `snakesim run` and `snakesim drive emulate can`, which must shut
    down in order, handle the signal themselves.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed by the caller, as by `>&-`: else the next file opened gets its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r"))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not if the shell ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    protect_children()
    pin(one_thread=True)  # before NumPy is imported
    try:
        from snakesim_operator.cli import main as command

        return command()
    except (MemoryError, ImportError, SystemError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.ENOMEM:
            raise
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if not isinstance(error, MemoryError) and limit == resource.RLIM_INFINITY:  # not for lack of memory
            raise
        allowed = "this computer has" if limit == resource.RLIM_INFINITY else f"`ulimit -v` allows, {limit // 2**20} MB"
        print_stderr(f"snakesim: this command needs more memory than {allowed}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
