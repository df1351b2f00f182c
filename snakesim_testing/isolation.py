"""Keep tests apart from the user's own robots and from other tests. Import this module before NumPy."""

import atexit
import os
import shutil
import signal
import tempfile

from snakesim_hal.base.arithmetic import pin_common_arithmetic

if "SNAKESIM_UNPINNED" not in os.environ:  # set by verification/computers/test_computers.py
    # So that what is computed in this process is what `snakesim` computes.
    pin_common_arithmetic(one_thread=True)

# What runs leave behind for this user (a latched stop, the list of live robots) must not meet that of other tests.
_state = tempfile.mkdtemp(prefix="snakesim-tests-")
os.environ["XDG_STATE_HOME"] = _state
atexit.register(shutil.rmtree, _state, ignore_errors=True)

# What a shell starts in the background ignores Ctrl-C, and so would all that tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
