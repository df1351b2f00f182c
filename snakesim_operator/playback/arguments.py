"""The commands for results: `snakesim replay`, `recording` and `study compare`."""

import argparse
import sys
from collections.abc import Callable
from math import inf
from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.endpoint import check_endpoint, check_namespace
from snakesim_hal.programs.arguments import add_json, add_namespace, add_out, add_set, add_task, number_type
from snakesim_hal.programs.commands import Command, Commands, Noun
from snakesim_operator.recording.stamps import ABOUT_STAMPS, CHOICES


def add_span(parser: argparse.ArgumentParser) -> None:
    """Add `--from` and `--to`, which select a part of a run."""
    for flag, name, default, verb in (("--from", "from_s", 0.0, "begin"), ("--to", "to_s", inf, "end")):
        about = f"{verb} S seconds in"
        parser.add_argument(flag, dest=name, type=number_type(0.0, inf, "s"), default=default, metavar="S", help=about)


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Add the run that a command reads."""
    parser.add_argument("recording", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")


def _add_speed(parser: argparse.ArgumentParser, limits: tuple[float, float]) -> None:
    parser.add_argument(
        "--speed",
        type=number_type(*limits),
        default=1.0,
        metavar="X",
        help="robot time over wall time, such as 2 for twice as fast as it was (default: 1)",
    )


def _add_fps(parser: argparse.ArgumentParser, parse: Callable[[str], float], default: float | None, about: str) -> None:
    parser.add_argument("--fps", type=parse, default=default, metavar="HZ", help=about)


def _add_info(parser: argparse.ArgumentParser) -> None:
    add_recording(parser)
    add_json(parser)


def _add_report(parser: argparse.ArgumentParser) -> None:
    add_recording(parser)
    add_out(parser, "the page, an HTML file (default: beside the recording)")


def _add_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("run_a", type=Path, metavar="RUN_A", help="folder of the run that percentages refer to")
    parser.add_argument(
        "run_b", type=Path, metavar="RUN_B", help="folder of the other run, of a robot with the same joints"
    )
    add_out(parser, "the page, an HTML file (default: RUN_B/compare.html)")
    parser.add_argument(
        "--within", type=float, metavar="PERCENT", help="exit with 1 when the distances moved differ by more"
    )
    add_json(parser)


def _add_replay(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim replay`, which plays a recording on a network or through the services."""
    add_recording(parser)
    _add_speed(parser, (0.001, 1e6))
    parser.add_argument("--step", action="store_true", help="play one tick at each Enter")
    parser.add_argument(
        "--endpoint", metavar="ENDPOINT", help="Zenoh endpoint to listen on (default: tcp/127.0.0.1:7447)"
    )
    add_namespace(parser)
    parser.add_argument(
        "--control", action="store_true", help="run the services on the recorded sensors, and compare their commands"
    )
    add_set(parser, "with --control: change any value of the configuration")
    parser.add_argument("--controller", metavar="NAME", help="with --control: another controller, as of `snakesim run`")
    parser.add_argument(
        "--run-recorded-code",
        action="store_true",
        help="with --control: run Python files that the recording names, as they are on this computer now",
    )
    add_out(parser, "with --control: folder for a run that `snakesim study compare` reads")


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RUN", help="folders of runs, or MCAP files")
    parser.add_argument(
        "--format", required=True, choices=["csv", "parquet", "npz", "lerobot", "mcap"], help="what to write"
    )
    add_out(parser, "file or folder (default: beside the recording)")
    parser.add_argument(
        "--images", action="store_true", help="lerobot: with the images of the cameras, in the recordings"
    )
    add_task(parser, "lerobot: the task, in words (default: the scenario's name)")
    parser.add_argument("--stamps", choices=CHOICES, help=f"mcap: {ABOUT_STAMPS} (default: as recorded)")
    _add_fps(parser, number_type(1.0, 1000.0, "Hz"), None, "lerobot: frames a second (default: the robot's rate)")


def _add_video(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim recording video`, which films a recorded run as MP4 or GIF."""
    add_recording(parser)
    add_out(parser, "FILE.mp4 or FILE.gif", required=True)
    parser.add_argument(
        "--width",
        type=number_type(16, 4096),
        default=1280,
        metavar="PIXELS",
        help="width of the picture, an even number (default: 1280)",
    )
    parser.add_argument(
        "--height",
        type=number_type(16, 4096),
        default=720,
        metavar="PIXELS",
        help="height of the picture, an even number (default: 720)",
    )
    _add_fps(parser, number_type(1.0, 240.0, "Hz"), 30.0, "frames a second (default: 30)")
    _add_speed(parser, (0.01, 100.0))
    add_span(parser)


def _info(arguments: argparse.Namespace) -> int:
    from snakesim_operator.playback.info import show_recording

    return show_recording(arguments.recording, print_line, as_json=arguments.json)


def _report(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.textfiles import write_text
    from snakesim_operator.results.missing_data import exit_code
    from snakesim_operator.results.report import page
    from snakesim_operator.results.run_log import RunRecord
    from snakesim_operator.results.run_reader import REPORT
    from snakesim_operator.results.summary import summarise

    path: Path = arguments.recording
    record = RunRecord.load(path)
    out = arguments.out or (path / REPORT if path.is_dir() else path.with_suffix(".html"))
    write_text(out, page(record, summarise(record, record.ending)))
    print_line(str(out))
    return exit_code(path, record.missing)


def _compare(arguments: argparse.Namespace) -> int:
    from snakesim_operator.results.compare import compare

    return compare(arguments.run_a, arguments.run_b, arguments.out, arguments.within, as_json=arguments.json)


def _video(arguments: argparse.Namespace) -> int:
    from snakesim_operator.playback.video import video

    size = (arguments.width, arguments.height)
    if any(pixels % 2 for pixels in size):
        raise ConfigError(
            f"--width {size[0]} --height {size[1]}: give even numbers of pixels", code="command/invalid-option"
        )
    span_s = (arguments.from_s, arguments.to_s)
    return video(arguments.recording, arguments.out, size=size, fps=arguments.fps, speed=arguments.speed, span_s=span_s)


def _export(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    if arguments.format in ("parquet", "lerobot"):
        extras.require("report", f"--format {arguments.format}")
    from snakesim_operator.playback.export import export, export_dataset

    if arguments.stamps is not None and arguments.format != "mcap":
        raise ConfigError(
            f"--stamps is for --format mcap, not {arguments.format}; leave it out", code="command/conflicting-options"
        )
    if arguments.format == "lerobot":
        choice = {"images": arguments.images, "task": arguments.task, "fps": arguments.fps}
        return export_dataset(arguments.recordings, arguments.out, print_line, **choice)
    if arguments.images or arguments.task is not None or arguments.fps is not None:
        raise ConfigError(
            f"--images, --task and --fps are for --format lerobot, not {arguments.format}; leave them out",
            code="command/conflicting-options",
        )
    return export(arguments.recordings, arguments.format, arguments.out, print_line, arguments.stamps)


def _replay(arguments: argparse.Namespace) -> int:
    """Run `snakesim replay`: publish the messages of a recording, or with `--control` run the services on its sensors.

    Args:
        arguments: The parsed options of the command.

    Returns:
        The exit code; 130 if the user interrupts the command.

    Raises:
        ConfigError: The recording cannot be read, or options contradict each other.
    """
    from snakesim_hal.model.scenario import Override, parse_set
    from snakesim_operator.playback.control import replay_control
    from snakesim_operator.playback.play import play
    from snakesim_operator.results.run_reader import find_recording

    path = find_recording(arguments.recording)
    if arguments.control:
        overrides = [parse_set(text) for text in arguments.set]
        if arguments.controller is not None:
            overrides.append(Override("controller", arguments.controller, "--controller"))
        return replay_control(path, overrides, arguments.out, print_line, run_recorded_code=arguments.run_recorded_code)

    has_control_option = arguments.set or arguments.out or arguments.controller or arguments.run_recorded_code
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
        return play(
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
        add=_add_replay,
        run=_replay,
        details="Exit code of --control 0: the commands are the same to the bit, or a setting was changed. 1: "
        "otherwise. 3: done, but something is missing in the recording.",
        examples=(
            "replay runs/demo --speed 0.5",
            "replay runs/demo --control --set control.speed_kp_s=0.3 --out runs/again",
        ),
    ),
    Noun(name="recording", heading="runs and studies", help="Inspect, convert and draw recorded runs."),
    Command(
        name="recording info",
        help="Print what a recording holds: keys, rates, sizes, gaps.",
        add=_add_info,
        run=_info,
        examples=("recording info runs/demo", "recording info test.mcap --json"),
    ),
    Command(
        name="recording report",
        help="Rewrite the page of a run, also from a recording alone.",
        add=_add_report,
        run=_report,
        examples=("recording report runs/demo", "recording report test.mcap --out test.html"),
    ),
    Command(
        name="recording export",
        help="Write a run as CSV, Parquet, NumPy, a LeRobot dataset or a whole MCAP.",
        add=_add_export,
        run=_export,
        examples=(
            "recording export runs/demo --format csv",
            "recording export runs/demo --format lerobot --out dataset --task 'through the pegs'",
        ),
    ),
    Command(
        name="recording video",
        help="Film a recorded run, as MP4 or GIF.",
        add=_add_video,
        run=_video,
        examples=(
            "recording video runs/demo --out demo.mp4",
            "recording video runs/demo --out demo.gif --speed 4 --from 2 --to 10",
        ),
    ),
    Noun(name="study", heading="runs and studies", help="Evaluate, sweep, optimize and compare runs."),
    Command(
        name="study compare",
        help="Compare two runs, as a table and as a page with plots.",
        add=_add_compare,
        run=_compare,
        examples=("study compare runs/a runs/b", "study compare runs/a runs/b --within 5 --json"),
    ),
)
