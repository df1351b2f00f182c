"""The command `snakesim recording plot`. Importable without the extra that it needs."""

import argparse

from snakesim_hal.programs.arguments import add_output_argument, make_number_parser
from snakesim_hal.programs.commands import Command, Commands
from snakesim_operator.playback.arguments import add_span_options


def _add_plot_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim recording plot`, which draws signals, paths or the figures of the paper."""
    parser.add_argument(
        "arguments",
        nargs="+",
        metavar="RUN [RUN ...] [SIGNAL ...]",
        help="folders of runs or MCAP files, which are overlaid; then signals, a pair of axes each (default: angle_rad "
        "torque_nm)",
    )
    parser.add_argument(
        "--mean",
        action="store_true",
        help="draw runs that differ in their seeds alone as their mean, with its 95 %% interval by Student's t",
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--path", action="store_true", help="instead: the paths of head and tail, from above"
    )
    instead.add_argument(
        "--paper",
        action="store_true",
        help="instead: the paper's Figures 8 to 13, of this run, one file each",
    )
    add_output_argument(
        parser, "FILE.pdf, .svg or .png, or a folder with --paper (default: in RUN)"
    )
    parser.add_argument(
        "--width-in",
        type=make_number_parser(1.0, 40.0, "inches"),
        default=3.5,
        metavar="INCHES",
        help="width of the figure in inches (default: 3.5, one column)",
    )
    parser.add_argument("--dark", action="store_true", help="on black, for slides")
    add_span_options(parser)


def _run_plot(arguments: argparse.Namespace) -> int:
    """Run `snakesim recording plot`: draw signals of one or several runs into a file. Return the exit code."""
    from snakesim_operator.base import extras

    extras.require_extra("report", "`snakesim recording plot`")
    from snakesim_operator.features.figures.inherited import import_matplotlib

    import_matplotlib()  # without the user's MPLBACKEND; must precede the import of `drawn`
    from snakesim_operator.features.figures.drawn import plot_runs

    return plot_runs(
        arguments.arguments,
        arguments.out,
        mean=arguments.mean,
        paper=arguments.paper,
        path=arguments.path,
        width_in=arguments.width_in,
        span_s=(arguments.from_s, arguments.to_s),
        dark=arguments.dark,
    )


COMMANDS: Commands = (
    Command(
        name="recording plot",
        help="Draw figures of runs for a paper: signals over time, the path, or those of the SnakeSIM paper.",
        add=_add_plot_arguments,
        run=_run_plot,
        details="Signals are named as in `snakesim recording export`. A comma puts several of one unit on one pair of "
        "axes: angle_rad.joint_7,target.joint_7. Several runs are overlaid, each in its color. Exit code 0: made. 2: "
        "wrong input. 3: made, but something is missing in a recording.",
        examples=(
            "recording plot runs/demo angle_rad.joint_7,target.joint_7 torque_nm --from 2 --to 6",
            "recording plot runs/a runs/b runs/c velocity_b_m_s.x --mean --out speed.png",
        ),
    ),
)
