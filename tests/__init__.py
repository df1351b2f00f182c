import atexit
import os
import shutil
import tempfile

# What runs leave behind for this user (a latched stop, the list of live robots) must not meet that of other tests.
_state = tempfile.mkdtemp(prefix="snakesim-tests-")
os.environ["XDG_STATE_HOME"] = _state
atexit.register(shutil.rmtree, _state, ignore_errors=True)
