"""The contract of a backend, unchanged, on every bench of ours: see conftest.py, and docs/backends.md."""

from snakesim_hal.conformance.test_closing import *  # noqa: F403
from snakesim_hal.conformance.test_description import *  # noqa: F403
from snakesim_hal.conformance.test_drives import *  # noqa: F403
from snakesim_hal.conformance.test_faults import *  # noqa: F403
from snakesim_hal.conformance.test_host import *  # noqa: F403
from snakesim_hal.conformance.test_lifecycle import *  # noqa: F403
from snakesim_hal.conformance.test_limits import *  # noqa: F403
from snakesim_hal.conformance.test_modes import *  # noqa: F403
from snakesim_hal.conformance.test_samples import *  # noqa: F403
from snakesim_hal.conformance.test_switching import *  # noqa: F403
