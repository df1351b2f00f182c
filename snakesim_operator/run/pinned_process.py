"""Calls a function in a child process, which computes in the common arithmetic (`snakesim_hal/base/arithmetic.py`).

Programs need this that imported NumPy before its processor code could be chosen.
"""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from snakesim_hal.base import errors
from snakesim_hal.base.arithmetic import common_environment
from snakesim_hal.base.process import child_environment, die_with_parent, python_command

ResultT = TypeVar("ResultT")
CALL_FILE = "call"  # holds the function and its arguments
ANSWER_FILE = "answer"
POLL_S = 1.0  # Python code runs again after so long, so that an exception can be raised in the caller's thread


def call_pinned(function: Callable[..., ResultT], **arguments: Any) -> ResultT:
    """Call a function in a process of its own, and return its result.

    Function, arguments and result travel as pickle files in a temporary folder.

    Args:
        function: A function on the top level of a module.
        **arguments: Its keyword arguments.

    Raises:
        SnakesimError: The function raised this error there, or the process ended without a result.
    """
    # The child gets the folder for its temporary files, too, which then are removed even if Ctrl-C kills it.
    with TemporaryDirectory(prefix="snakesim-") as folder:
        call_path = Path(folder) / CALL_FILE
        answer_path = Path(folder) / ANSWER_FILE
        call_path.write_bytes(pickle.dumps((function, arguments)))
        variables = {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": folder}
        process = subprocess.Popen(
            python_command("-m", "snakesim_operator.run.pinned_process", folder, str(os.getpid())),
            env=child_environment(common_environment(), variables),
            stdin=subprocess.DEVNULL,
        )
        try:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(POLL_S)
        finally:
            process.kill()
            process.wait()
        if process.returncode:
            raise errors.SnakesimError(f"the process of the run ended with exit code {process.returncode}; see above")
        answer = pickle.loads(answer_path.read_bytes())
    if isinstance(answer, tuple):  # the error that the function raised
        error_name, lines, code = answer
        error_type = getattr(errors, error_name, errors.SnakesimError)
        error = error_type(*lines)
        error.code = code
        raise error
    return answer


def main() -> int:
    """Run the child process. Its arguments are the folder and the parent's process id."""
    folder = Path(sys.argv[1])
    parent_pid = int(sys.argv[2])
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches both processes; the parent reports it
    die_with_parent(parent_pid)
    function, arguments = pickle.loads((folder / CALL_FILE).read_bytes())
    try:
        answer: Any = function(**arguments)
    except errors.SnakesimError as error:
        answer = type(error).__name__, error.lines, error.code
    (folder / ANSWER_FILE).write_bytes(pickle.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
