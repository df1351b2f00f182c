"""A function in a child process, which computes in the common arithmetic (`snakesim_hal/base/arithmetic.py`).

For programs that imported NumPy before it could be told which processor code to choose.
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
from snakesim_hal.base.arithmetic import environment
from snakesim_hal.base.process import child_environment, die_with_parent, python_command

ResultT = TypeVar("ResultT")
ASKED, ANSWER = "asked", "answer"
LOOK_S = 1.0  # Python code runs again after so long, so that an exception can be raised into the caller's thread


def call_pinned(function: Callable[..., ResultT], **asked: Any) -> ResultT:
    """Call a function of a module with these arguments in a process of its own. Raises as it does."""
    with TemporaryDirectory(prefix="snakesim-") as folder:  # also for the child's own, which Ctrl-C kills
        (Path(folder) / ASKED).write_bytes(pickle.dumps((function, asked)))
        process = subprocess.Popen(
            python_command("-m", "snakesim_operator.run.pinned_process", folder, str(os.getpid())),
            env=child_environment(environment(), {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": folder}),
            stdin=subprocess.DEVNULL,
        )
        try:
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(LOOK_S)
        finally:
            process.kill()
            process.wait()
        if process.returncode:
            raise errors.SnakesimError(f"the process of the run ended with exit code {process.returncode}; see above")
        answer = pickle.loads((Path(folder) / ANSWER).read_bytes())
    if isinstance(answer, tuple):
        kind, lines = answer
        raise getattr(errors, kind, errors.SnakesimError)(*lines)
    return answer


def main() -> int:
    """The child: the arguments are the folder and the parent's process id."""
    folder, parent = Path(sys.argv[1]), int(sys.argv[2])
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches both; the parent tells of it
    die_with_parent(parent)
    function, asked = pickle.loads((folder / ASKED).read_bytes())
    try:
        answer: Any = function(**asked)
    except errors.SnakesimError as error:
        answer = type(error).__name__, error.lines
    (folder / ANSWER).write_bytes(pickle.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
