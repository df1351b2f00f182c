"""The commands for results: `snakesim replay`, `recording` and `study compare`."""

import argparse
import sys
from collections.abc import Callable
from math import inf
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.endpoint import check_endpoint, check_namespace
from snakesim_hal.programs.arguments import (
    add_json_argument,
    add_namespace_argument,
    add_output_argument,
    add_set_argument,
    add_task_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.recording.log_clock import LOG_TIME_CLOCK_HELP, LOG_TIME_CLOCKS


def add_span_options(parser: argparse.ArgumentParser) -> None:
    """Add `--from` and `--to`, which select a part of a run."""
    for flag, name, default, verb in (
        ("--from", "from_s", 0.0, "begin"),
        ("--to", "to_s", inf, "end"),
    ):
        about = f"{verb} S seconds in"
        parser.add_argument(
            flag,
            dest=name,
            type=make_number_parser(0.0, inf, "s"),
            default=default,
            metavar="S",
            help=about,
        )


def add_recording_argument(parser: argparse.ArgumentParser) -> None:
    """Add the run that a command reads."""
    parser.add_argument(
        "recording", type=Path, metavar="RUN", help="folder of a run, or an MCAP file"
    )


def _add_speed_option(parser: argparse.ArgumentParser, limits: tuple[float, float]) -> None:
    parser.add_argument(
        "--speed",
        type=make_number_parser(*limits),
        default=1.0,
        metavar="X",
        help="robot time over wall time, such as 2 for twice as fast as it was (default: 1)",
    )


def _add_fps_option(
    parser: argparse.ArgumentParser,
    parse: Callable[[str], float],
    default: float | None,
    help_text: str,
) -> None:
    parser.add_argument("--fps", type=parse, default=default, metavar="HZ", help=help_text)


def _add_info_options(parser: argparse.ArgumentParser) -> None:
    add_recording_argument(parser)
    add_json_argument(parser)


def _add_report_options(parser: argparse.ArgumentParser) -> None:
    add_recording_argument(parser)
    add_output_argument(parser, "the page, an HTML file (default: beside the recording)")


def _add_compare_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "run_a", type=Path, metavar="RUN_A", help="folder of the run that percentages refer to"
    )
    parser.add_argument(
        "run_b",
        type=Path,
        metavar="RUN_B",
        help="folder of the other run, of a robot with the same joints",
    )
    add_output_argument(parser, "the page, an HTML file (default: RUN_B/compare.html)")
    parser.add_argument(
        "--within",
        type=float,
        metavar="PERCENT",
        help="exit with 1 when the distances moved differ by more",
    )
    add_json_argument(parser)


def _add_replay_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim replay`, which plays a recording on a network or through the services."""
    add_recording_argument(parser)
    _add_speed_option(parser, (0.001, 1e6))
    parser.add_argument("--step", action="store_true", help="play one tick at each Enter")
    parser.add_argument(
        "--endpoint",
        metavar="ENDPOINT",
        help="Zenoh endpoint to listen on (default: tcp/127.0.0.1:7447)",
    )
    add_namespace_argument(parser)
    parser.add_argument(
        "--control",
        action="store_true",
        help="run the services on the recorded sensors, and compare their commands",
    )
    add_set_argument(parser, "with --control: change any value of the configuration")
    parser.add_argument(
        "--controller",
        metavar="NAME",
        help="with --control: another controller, as of `snakesim run`",
    )
    parser.add_argument(
        "--run-recorded-code",
        action="store_true",
        help="with --control: run Python files that the recording names, as they are on this computer now",
    )
    add_output_argument(
        parser, "with --control: folder for a run that `snakesim study compare` reads"
    )


def _add_export_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings", type=Path, nargs="+", metavar="RUN", help="folders of runs, or MCAP files"
    )
    parser.add_argument(
        "--format",
        required=True,
        choices=["csv", "parquet", "npz", "lerobot", "mcap"],
        help="what to write",
    )
    add_output_argument(parser, "file or folder (default: beside the recording)")
    parser.add_argument(
        "--images",
        action="store_true",
        help="lerobot: with the images of the cameras, in the recordings",
    )
    add_task_argument(parser, "lerobot: the task, in words (default: the scenario's name)")
    parser.add_argument(
        "--stamps",
        choices=LOG_TIME_CLOCKS,
        help=f"mcap: {LOG_TIME_CLOCK_HELP} (default: as recorded)",
    )
    _add_fps_option(
        parser,
        make_number_parser(1.0, 1000.0, "Hz"),
        None,
        "lerobot: frames a second (default: the robot's rate)",
    )


def _add_video_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim recording video`, which films a recorded run as MP4 or GIF."""
    add_recording_argument(parser)
    add_output_argument(parser, "FILE.mp4 or FILE.gif", required=True)
    parser.add_argument(
        "--width",
        type=make_number_parser(16, 4096),
        default=1280,
        metavar="PIXELS",
        help="width of the picture, an even number (default: 1280)",
    )
    parser.add_argument(
        "--height",
        type=make_number_parser(16, 4096),
        default=720,
        metavar="PIXELS",
        help="height of the picture, an even number (default: 720)",
    )
    _add_fps_option(
        parser, make_number_parser(1.0, 240.0, "Hz"), 30.0, "frames a second (default: 30)"
    )
    _add_speed_option(parser, (0.01, 100.0))
    add_span_options(parser)


def _show_recording(arguments: argparse.Namespace) -> int:
    from snakesim_operator.playback.info import print_recording_info

    return print_recording_info(arguments.recording, print_line, as_json=arguments.json)


def _write_report(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.textfiles import write_text
    from snakesim_operator.results.missing_data import report_missing_data
    from snakesim_operator.results.report import render_report
    from snakesim_operator.results.run_log import RunRecord
    from snakesim_operator.results.run_reader import REPORT_FILENAME
    from snakesim_operator.results.summary import summarize_run

    path: Path = arguments.recording
    record = RunRecord.load(path)
    out = arguments.out or (path / REPORT_FILENAME if path.is_dir() else path.with_suffix(".html"))
    write_text(out, render_report(record, summarize_run(record, record.ending)))
    print_line(str(out))
    return report_missing_data(path, record.missing)


def _compare_runs(arguments: argparse.Namespace) -> int:
    from snakesim_operator.results.compare import compare_runs

    return compare_runs(
        arguments.run_a, arguments.run_b, arguments.out, arguments.within, as_json=arguments.json
    )


def _film_run(arguments: argparse.Namespace) -> int:
    from snakesim_operator.playback.video import film_run

    size = (arguments.width, arguments.height)
    if any(pixels % 2 for pixels in size):
        raise ConfigError(
            f"--width {size[0]} --height {size[1]}: give even numbers of pixels",
            code="command/invalid-option",
        )
    span_s = (arguments.from_s, arguments.to_s)
    return film_run(
        arguments.recording,
        arguments.out,
        size=size,
        fps=arguments.fps,
        speed=arguments.speed,
        span_s=span_s,
    )


def _export_runs(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    if arguments.format in ("parquet", "lerobot"):
        extras.require_extra("report", f"--format {arguments.format}")
    from snakesim_operator.playback.export import export_dataset, export_run

    if arguments.stamps is not None and arguments.format != "mcap":
        raise ConfigError(
            f"--stamps is for --format mcap, not {arguments.format}; leave it out",
            code="command/conflicting-options",
        )
    if arguments.format == "lerobot":
        choice = {"images": arguments.images, "task": arguments.task, "fps": arguments.fps}
        return export_dataset(arguments.recordings, arguments.out, print_line, **choice)
    if arguments.images or arguments.task is not None or arguments.fps is not None:
        raise ConfigError(
            f"--images, --task and --fps are for --format lerobot, not {arguments.format}; leave them out",
            code="command/conflicting-options",
        )
    return export_run(
        arguments.recordings, arguments.format, arguments.out, print_line, arguments.stamps
    )


def _replay_recording(arguments: argparse.Namespace) -> int:
    """Run `snakesim replay`: publish the messages of a recording, or with `--control` run the services on its sensors.

    Args:
        arguments: Parsed options of the command.

    Returns:
        The exit code; 130 if the user interrupts the command.

    Raises:
        ConfigError: The recording cannot be read, or the options contradict each other.
    """
    from snakesim_hal.model.scenario import KeyOverride, parse_set_option
    from snakesim_operator.playback.control import replay_and_compare_commands
    from snakesim_operator.playback.play import play_recording
    from snakesim_operator.results.run_reader import find_recording_path

    path = find_recording_path(arguments.recording)
    if arguments.control:
        overrides = [parse_set_option(text) for text in arguments.set]
        if arguments.controller is not None:
            overrides.append(KeyOverride("controller", arguments.controller, "--controller"))
        return replay_and_compare_commands(
            path,
            overrides,
            arguments.out,
            print_line,
            run_recorded_code=arguments.run_recorded_code,
        )

    has_control_option = (
        arguments.set or arguments.out or arguments.controller or arguments.run_recorded_code
    )
    if has_control_option:
        raise ConfigError(
            "--set, --controller, --run-recorded-code and --out are for --control, which runs the services; add it, or "
            "leave them out",
            code="command/conflicting-options",
        )
    if arguments.endpoint is not None:
        check_endpoint(arguments.endpoint, "--endpoint")
    if arguments.namespace is not None:
        check_namespace(arguments.namespace, "--namespace")
    try:
        return play_recording(
            path,
            iter(sys.stdin),
            print_line,
            endpoint=arguments.endpoint,
            namespace=arguments.namespace,
            rate=arguments.speed,
            step=arguments.step,
        )
    except KeyboardInterrupt:
        return 130


COMMANDS: Commands = (
    Command(
        name="replay",
        heading="daily work",
        help="Play a recording on Zenoh, or its sensors into guidance, navigation and control.",
        add=_add_replay_options,
        run=_replay_recording,
        details="Exit code of --control 0: the commands are the same to the bit, or a setting was changed. 1: "
        "otherwise. 3: done, but something is missing in the recording.",
        examples=(
            "replay runs/demo --speed 0.5",
            "replay runs/demo --control --set control.speed_kp_s=0.3 --out runs/again",
        ),
    ),
    CommandGroup(
        name="recording",
        heading="runs and studies",
        help="Inspect, convert and draw recorded runs.",
    ),
    Command(
        name="recording info",
        help="Print what a recording holds: keys, rates, sizes, gaps.",
        add=_add_info_options,
        run=_show_recording,
        examples=("recording info runs/demo", "recording info test.mcap --json"),
    ),
    Command(
        name="recording report",
        help="Rewrite the page of a run, also from a recording alone.",
        add=_add_report_options,
        run=_write_report,
        examples=("recording report runs/demo", "recording report test.mcap --out test.html"),
    ),
    Command(
        name="recording export",
        help="Write a run as CSV, Parquet, NumPy, a LeRobot dataset or a whole MCAP.",
        add=_add_export_options,
        run=_export_runs,
        examples=(
            "recording export runs/demo --format csv",
            "recording export runs/demo --format lerobot --out dataset --task 'through the pegs'",
        ),
    ),
    Command(
        name="recording video",
        help="Film a recorded run, as MP4 or GIF.",
        add=_add_video_options,
        run=_film_run,
        examples=(
            "recording video runs/demo --out demo.mp4",
            "recording video runs/demo --out demo.gif --speed 4 --from 2 --to 10",
        ),
    ),
    CommandGroup(
        name="study", heading="runs and studies", help="Evaluate, sweep, optimize and compare runs."
    ),
    Command(
        name="study compare",
        help="Compare two runs, as a table and as a page with plots.",
        add=_add_compare_options,
        run=_compare_runs,
        examples=("study compare runs/a runs/b", "study compare runs/a runs/b --within 5 --json"),
    ),
)
