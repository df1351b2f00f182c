"""The report on a run: one page that needs no network, no program and no other file, `report.html`.

`timeline`, `snapshots`, `events`, `verdict` find the content; `playback`, `top_view`, `polygon` draw the snake and
its forces, `figures` names the charts; `page` and the template `report.html` put it together. Imports the HAL only.
"""

from snakesim_operator.results.report.page import page, playback_page

__all__ = ["page", "playback_page"]
