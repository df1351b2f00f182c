"""Entry point of the `snakesim` command."""

import os
import resource
import signal
import sys

from snakesim_hal.arithmetic import pin
from snakesim_hal.terminal import print_stderr


def main() -> int:
    """The command's exit code.

    Ctrl-C ends a command at once, by the signal itself, also during import and exit, where
    Python would print a traceback. `snakesim run` and `snakesim modules`, which must shut
    down in order, handle the signal themselves.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:  # closed by the caller, as by `>&-`: else the next file opened gets its number
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), "w" if number else "r"))
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not if the shell ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    pin(one_thread=True)  # before NumPy is imported
    try:
        from snakesim_operator.cli import main as command

        return command()
    except (MemoryError, ImportError, SystemError) as error:
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if not isinstance(error, MemoryError) and limit == resource.RLIM_INFINITY:  # not for lack of memory
            raise
        allowed = "this computer has" if limit == resource.RLIM_INFINITY else f"`ulimit -v` allows, {limit // 2**20} MB"
        print_stderr(f"snakesim: this command needs more memory than {allowed}")
        return 1


if __name__ == "__main__":
    sys.exit(main())
