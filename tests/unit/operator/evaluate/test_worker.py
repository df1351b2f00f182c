"""Worker processes of an evaluation stand behind whoever watches a run, and no further."""

import os
import subprocess
import sys

import pytest

SAYS = "import os; from snakesim_operator.evaluate.worker import dask_setup; dask_setup(None); print(os.nice(0))"


@pytest.mark.parametrize("already", [0, 4])
def test_niceness_is_not_added_to_that_of_the_command(already: int) -> None:
    begun = os.nice(0) + already
    said = subprocess.run(
        ["nice", "-n", str(already), sys.executable, "-c", SAYS], capture_output=True, text=True, check=True, timeout=60
    )
    assert int(said.stdout) == max(begun, 10)
