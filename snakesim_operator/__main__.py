"""Entry point of the `snakesim` command."""

import os
import signal
import sys

from snakesim_hal.arithmetic import pin


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
    pin()  # before NumPy is imported
    from snakesim_operator.cli import main as command

    return command()


if __name__ == "__main__":
    sys.exit(main())
