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
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from snakesim_hal.base import errors
from snakesim_hal.base.arithmetic import make_common_arithmetic_env
from snakesim_hal.base.process import (
    make_child_environment,
    make_python_command,
    set_parent_death_signal,
)

ResultT = TypeVar("ResultT")
CALL_FILENAME = "call"  # holds the function and its arguments
RESULT_FILENAME = "result"
# The module keeps its own name in the child: the caller cannot unpickle an instance of `__main__._RaisedError`.
CHILD_CODE = f"import sys; from {__name__} import main; sys.exit(main())"
POLL_S = 1.0  # Python code runs again after so long, so that an exception can be raised in the caller's thread


@dataclass(frozen=True)
class _RaisedError:
    """A SnakesimError that the function raised in the child, in the place of a result."""

    class_name: str
    lines: tuple[str, ...]
    code: str

    def make_error(self) -> errors.SnakesimError:
        """Return an error of the same class, with the same text and code."""
        error_type = getattr(errors, self.class_name, errors.SnakesimError)
        error = error_type(*self.lines)
        error.code = self.code
        return error


def call_in_pinned_process(function: Callable[..., ResultT], **arguments: Any) -> ResultT:
    """Call a function in a child process with pinned arithmetic, and return its result.

    Function, arguments and result travel as pickle files in a temporary folder.

    Args:
        function: Function at the top level of a module.
        **arguments: Keyword arguments of the function.

    Returns:
        The value that the function returned.

    Raises:
        SnakesimError: The function raised this error in the child, or the child ended without a result.
    """
    # The folder is also TMPDIR of the child, so that its temporary files are removed even if Ctrl-C kills it.
    with TemporaryDirectory(prefix="snakesim-") as folder:
        call_path = Path(folder) / CALL_FILENAME
        result_path = Path(folder) / RESULT_FILENAME
        call_path.write_bytes(pickle.dumps((function, arguments)))
        variables = {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": folder}
        process = subprocess.Popen(
            make_python_command("-c", CHILD_CODE, folder, str(os.getpid())),
            env=make_child_environment(make_common_arithmetic_env(), variables),
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
            raise errors.SnakesimError(
                f"the process of the run ended with exit code {process.returncode}; see above"
            )
        outcome = pickle.loads(result_path.read_bytes())
    if isinstance(outcome, _RaisedError):
        raise outcome.make_error()
    return outcome


def main() -> int:
    """Run the child process: load the call, call the function, and store the result or the error in a file.

    The command line has two arguments: the temporary folder, and the process id of the parent. Any other exception than
    a SnakesimError leaves no file: Python prints its traceback, and ends this process with exit code 1.

    Returns:
        The exit code, 0.
    """
    folder = Path(sys.argv[1])
    parent_pid = int(sys.argv[2])
    # Ctrl-C reaches both processes, and the parent reports it. With the default action the child ends silently, without
    # the traceback of a KeyboardInterrupt.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    set_parent_death_signal(parent_pid)
    function, arguments = pickle.loads((folder / CALL_FILENAME).read_bytes())
    try:
        outcome: Any = function(**arguments)
    except errors.SnakesimError as error:
        outcome = _RaisedError(type(error).__name__, error.lines, error.code)
    (folder / RESULT_FILENAME).write_bytes(pickle.dumps(outcome))
    return 0
