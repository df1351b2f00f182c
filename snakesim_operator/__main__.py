"""Where the `snakesim` command begins."""

import signal
import sys


def main() -> int:
    """The command's exit code.

    Ctrl-C ends a command at once, by the signal itself: while modules are imported, while it runs, while it ends.
    Python would print a traceback at most of these moments. `snakesim run` and `snakesim modules`, which have something
    to end in order, handle the signal themselves.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not when a shell has it ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from snakesim_operator.cli import main as command

    return command()


if __name__ == "__main__":
    sys.exit(main())
