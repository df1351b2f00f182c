"""Isolates tests from the robots of the user and from other tests. Import this module before NumPy."""

import atexit
import os
import shutil
import signal
import tempfile

from snakesim_hal.base.arithmetic import pin_common_arithmetic

if "SNAKESIM_UNPINNED" not in os.environ:  # set by verification/computers/test_computers.py
    # The numbers of this process must be equal to those of `snakesim`.
    pin_common_arithmetic(one_thread=True)

# Runs write files for this user: a latched stop, and the list of live robots. Other tests must not find them.
_state = tempfile.mkdtemp(prefix="snakesim-tests-")
os.environ["XDG_STATE_HOME"] = _state
atexit.register(shutil.rmtree, _state, ignore_errors=True)

# A process that a shell starts in the background ignores Ctrl-C, and so would all processes that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
