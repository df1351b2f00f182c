"""Measured ratios: each compares SnakeSIM with the least that could do the same job, in one run, on one machine.

`python -m benchmarks` prints them all; absolute times on a shared machine mean little, so medians of ratios are quoted.
"""

from snakesim_hal.base.arithmetic import pin

pin()  # before NumPy: so that a run in this process stays in it, where it can be measured

import snakesim_testing.isolation  # noqa: E402, F401 - latched stops and lists of robots stay apart from the user's
