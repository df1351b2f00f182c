"""Two runs side by side: what they were commanded, how far they got, and where and when their joints differ.

`compare`   loads two run folders, prints the table, writes the page: the command
`differ`    the numbers alone, without any file

`alignment` puts both on one time axis, `difference` works the numbers out, `following` lag and gain of each joint,
`settings` finds what was set differently;
`table` prints, `figures` and `page` draw with the parts of `snakesim_operator.results.report`. Imports the HAL only.
"""

from snakesim_operator.results.compare.command import compare
from snakesim_operator.results.compare.difference import differ

__all__ = ["compare", "differ"]
