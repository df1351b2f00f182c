"""The report of a run: one self-contained page, `report.html`.

`timeline`, `snapshots`, `events`, `verdict` find the content; `playback`, `top_view`, `polygon` draw the snake and
its forces, `figures` draws the charts; `page` and the template `report.html` put it together. Imports the HAL only.
"""

from snakesim_operator.results.report.page import render_playback_page, render_report

__all__ = ["render_playback_page", "render_report"]
