"""Arguments of `snakesim plot`. Importable without the extra that it needs."""

import argparse
from pathlib import Path
from typing import Any

from snakesim_hal.programs.arguments import number_type
from snakesim_operator.playback.arguments import add_span

TASK = "results"  # under which `snakesim --help` lists it


def add_commands(commands: Any) -> None:
    """Add it to the parser of `snakesim`."""
    plot = commands.add_parser(
        "plot",
        help="figures of a run for a paper: signals over time, or those of the SnakeSIM paper",
        epilog="Signals are named as in `snakesim export`. A comma puts several of one unit on one pair of axes: "
        "angle_rad.joint_7,target.joint_7. Exit code: 0; 2 wrong input; 3 made, but the recording is incomplete.",
    )
    plot.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or a recording")
    plot.add_argument("signals", nargs="*", metavar="SIGNAL", help="a pair of axes each (default: angle_rad torque_nm)")
    plot.add_argument(
        "--paper", action="store_true", help="instead: the paper's Figures 8 to 13, of this run, one file each"
    )
    plot.add_argument(
        "--out", type=Path, metavar="PATH", help="FILE.pdf, .svg or .png; with --paper a folder (default: in RUN)"
    )
    plot.add_argument("--width", type=number_type(1.0, 40.0, "inches"), default=3.5, help="in inches (3.5: one column)")
    plot.add_argument("--dark", action="store_true", help="on black, for slides")
    add_span(plot)
    plot.set_defaults(act=_plot)


def _plot(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    extras.require("report", "`snakesim plot`")
    from snakesim_operator.features.figures.inherited import import_matplotlib

    import_matplotlib()
    from snakesim_operator.features.figures.drawn import plot

    return plot(
        arguments.run,
        arguments.signals,
        arguments.out,
        paper=arguments.paper,
        width_in=arguments.width,
        span_s=(arguments.from_s, arguments.to_s),
        dark=arguments.dark,
    )
