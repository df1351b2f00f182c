"""Charts of signals: figures on one page, for a notebook or a file."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from snakesim_hal.model.textfiles import write_text
from snakesim_operator.results.page.charts import PlotlyDict
from snakesim_operator.results.page.html import render_page

PAGE_TEMPLATE = Path(__file__).with_name("plot.html")
MARGIN_PX = 30  # below each figure
PADDING_PX = 160  # of the page


@dataclass(frozen=True)
class Chart:
    """Figures of signals over time. A notebook shows them."""

    title: str  # of the page
    figures: Sequence[PlotlyDict]  # in the form of Plotly, from top to bottom
    joints: int  # number of joints, each of which has its own color

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write one page of HTML that needs no network and no other file.

        Args:
            path: The file to write.

        Returns:
            The path of the file.

        Raises:
            ConfigError: The file cannot be written.
        """
        write_text(Path(path), self._render_page())
        return Path(path)

    def _repr_html_(self) -> str:
        heights = [figure["layout"]["height"] + MARGIN_PX for figure in self.figures]
        return embed_in_iframe(self._render_page(), sum(heights) + PADDING_PX)

    def _render_page(self) -> str:
        return render_page(PAGE_TEMPLATE, self.joints, title=self.title, figures=self.figures)


def embed_in_iframe(page: str, height_px: int) -> str:
    """Return HTML that shows a page within another one, isolated from it."""
    style = f"width:100%;height:{height_px}px;border:0"
    return f'<iframe style="{style}" sandbox="allow-scripts allow-downloads" srcdoc="{escape(page)}"></iframe>'
