"""The report on a run: one page that needs no network, no program and no other file, `report.html`.

`page`           the page
`write_picture`  the best instant alone, as an SVG for a README

`timeline`, `instants`, `verdict` work out what to say; `charts`, `top_view`, `polygon`, `torque_map` draw it;
`page` and `tables` put it together. Everything is drawn by hand (`svg`), so nothing has to be installed for it.
Like the rest of this package it imports the HAL only.
"""

from snakesim_operator.results.report.page import page
from snakesim_operator.results.report.picture import write_picture

__all__ = ["page", "write_picture"]
