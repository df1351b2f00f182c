"""Compares two runs: what was commanded, how far they moved, and where and when their joints differ.

`compare_runs`         loads two run folders, prints the table, writes the page: the command
`compute_difference`   computes the comparison alone, without any file

`alignment` samples both on one time axis, `difference` compares them, `following` fits lag and gain of each joint,
`settings` finds the settings that differ;
`table` prints, `figures` and `page` draw with the parts of `snakesim_operator.results.report`. Imports the HAL only.
"""

from snakesim_operator.results.compare.command import compare_runs
from snakesim_operator.results.compare.difference import compute_difference

__all__ = ["compare_runs", "compute_difference"]
