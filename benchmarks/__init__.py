"""Measured ratios: each compares SnakeSIM with the least that could do the same job, in one run, on one machine.

`python -m benchmarks` prints all of them. Absolute times on a shared machine mean little, so the table quotes medians
of ratios.
"""

from snakesim_hal.base.arithmetic import pin_common_arithmetic

# Before NumPy is imported: a run in this process then stays on one thread, where it can be measured.
pin_common_arithmetic()

import snakesim_testing.isolation  # noqa: E402, F401 - latched stops and lists of robots stay apart from the user's
