"""The contract of a backend, on every bench: see conftest.py and docs/hardware/contract-suite.md."""

from snakesim_testing.contract.test_closing import *  # noqa: F403
from snakesim_testing.contract.test_description import *  # noqa: F403
from snakesim_testing.contract.test_drives import *  # noqa: F403
from snakesim_testing.contract.test_faults import *  # noqa: F403
from snakesim_testing.contract.test_host import *  # noqa: F403
from snakesim_testing.contract.test_lifecycle import *  # noqa: F403
from snakesim_testing.contract.test_limits import *  # noqa: F403
from snakesim_testing.contract.test_modes import *  # noqa: F403
from snakesim_testing.contract.test_recovery import *  # noqa: F403
from snakesim_testing.contract.test_samples import *  # noqa: F403
from snakesim_testing.contract.test_switching import *  # noqa: F403
