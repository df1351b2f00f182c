"""Arguments of the commands for results: `snakesim info`, `report`, `compare`, `replay`, `export`, `video`."""

import argparse
import sys
from math import inf
from pathlib import Path
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.endpoint import check_endpoint, check_namespace
from snakesim_hal.programs.arguments import add_json, number_type


def add_commands(commands: Any) -> None:
    """Add the commands to the parser of `snakesim`."""
    _add_info(commands)
    _add_report(commands)
    _add_compare(commands)
    _add_replay(commands)
    _add_export(commands)
    _add_video(commands)


def _add_info(commands: Any) -> None:
    info = commands.add_parser("info", help="print what a recording holds: keys, rates, sizes, gaps")
    _add_recording(info)
    add_json(info)
    info.set_defaults(act=_info)


def _add_report(commands: Any) -> None:
    report = commands.add_parser("report", help="rewrite the page of a run, also from a recording alone")
    _add_recording(report)
    report.add_argument("--out", type=Path, metavar="FILE.html", help="the page (default: beside the recording)")
    report.set_defaults(act=_report)


def _add_compare(commands: Any) -> None:
    compare = commands.add_parser("compare", help="compare two runs, as a table and as a page with plots")
    compare.add_argument("run_a", type=Path, metavar="RUN_A", help="folder of a run; percentages refer to this one")
    compare.add_argument(
        "run_b", type=Path, metavar="RUN_B", help="folder of the other run, of a robot with the same joints"
    )
    compare.add_argument("--out", type=Path, metavar="FILE.html", help="the page (default: RUN_B/compare.html)")
    compare.add_argument(
        "--within", type=float, metavar="PERCENT", help="exit with 1 when the distances moved differ by more"
    )
    add_json(compare)
    compare.set_defaults(act=_compare)


def _add_replay(commands: Any) -> None:
    replay = commands.add_parser(
        "replay",
        help="play a recording on Zenoh, or its sensors into guidance, navigation and control",
        epilog="Exit code of --control: 0 the commands are the same to the bit, or a setting was changed; 1 otherwise. "
        "3: done, but the recording is incomplete.",
    )
    _add_recording(replay)
    replay.add_argument(
        "--rate", type=number_type(0.001, 1e6), default=1.0, metavar="X", help="robot time over wall time (1)"
    )
    replay.add_argument("--step", action="store_true", help="play one tick at each Enter")
    replay.add_argument("--endpoint", help="Zenoh endpoint to listen on (default: tcp/127.0.0.1:7447)")
    replay.add_argument("--namespace", help="namespace to play in (default: the robot's name)")
    replay.add_argument(
        "--control", action="store_true", help="run the services on the recorded sensors, and compare their commands"
    )
    replay.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="with --control: change a setting; repeatable"
    )
    replay.add_argument("--controller", metavar="NAME", help="with --control: another controller, as of `snakesim run`")
    replay.add_argument(
        "--run-recorded-code",
        action="store_true",
        help="with --control: run Python files that the recording names, as they are on this computer now",
    )
    replay.add_argument("--out", type=Path, metavar="DIR", help="with --control: folder for a run that compare reads")
    replay.set_defaults(act=_replay)


def _add_export(commands: Any) -> None:
    exported = commands.add_parser(
        "export", help="write a run as CSV, Parquet, NumPy, a LeRobot dataset or a whole MCAP"
    )
    exported.add_argument("recordings", type=Path, nargs="+", metavar="RUN", help="folders of runs, or MCAP files")
    exported.add_argument("--format", required=True, choices=["csv", "parquet", "npz", "lerobot", "mcap"])
    exported.add_argument("--out", type=Path, metavar="PATH", help="file or folder (default: beside the recording)")
    exported.add_argument("--images", action="store_true", help="lerobot: with what the cameras saw, in the recordings")
    exported.add_argument("--task", metavar="TEXT", help="lerobot: the task, in words (default: the scenario's name)")
    exported.add_argument(
        "--fps",
        type=number_type(1.0, 1000.0, "Hz"),
        metavar="HZ",
        help="lerobot: frames a second (default: the robot's rate)",
    )
    exported.set_defaults(act=_export)


def _add_video(commands: Any) -> None:
    video = commands.add_parser("video", help="film a recorded run, as MP4 or GIF")
    video.add_argument("run", type=Path, metavar="RUN", help="folder of a run, or a recording")
    video.add_argument("--out", type=Path, required=True, metavar="FILE", help="FILE.mp4 or FILE.gif")
    video.add_argument(
        "--width", type=number_type(16, 4096), default=1280, help="pixels, an even number (default: 1280)"
    )
    video.add_argument(
        "--height", type=number_type(16, 4096), default=720, help="pixels, an even number (default: 720)"
    )
    video.add_argument(
        "--fps", type=number_type(1.0, 240.0, "Hz"), default=30.0, help="pictures a second (default: 30)"
    )
    video.add_argument(
        "--speed",
        type=number_type(0.01, 100.0),
        default=1.0,
        metavar="X",
        help="2: twice as fast as it was (default: 1)",
    )
    add_span(video)
    video.set_defaults(act=_video)


def add_span(parser: argparse.ArgumentParser) -> None:
    """Add `--from` and `--to`, which select a part of a run."""
    for flag, name, default, verb in (("--from", "from_s", 0.0, "begin"), ("--to", "to_s", inf, "end")):
        about = f"{verb} S seconds in"
        parser.add_argument(flag, dest=name, type=number_type(0.0, inf, "s"), default=default, metavar="S", help=about)


def _add_recording(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")


def _info(arguments: argparse.Namespace) -> int:
    from snakesim_operator.playback.info import show

    return show(arguments.recording, print_line, as_json=arguments.json)


def _report(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.textfiles import write_text
    from snakesim_operator.results.missing_data import exit_code
    from snakesim_operator.results.report import page
    from snakesim_operator.results.run_log import RunRecord
    from snakesim_operator.results.run_reader import REPORT
    from snakesim_operator.results.summary import summarise

    given: Path = arguments.recording
    record = RunRecord.load(given)
    out = arguments.out or (given / REPORT if given.is_dir() else given.with_suffix(".html"))
    write_text(out, page(record, summarise(record, record.ending)))
    print_line(str(out))
    return exit_code(given, record.missing)


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
    return video(arguments.run, arguments.out, size=size, fps=arguments.fps, speed=arguments.speed, span_s=span_s)


def _export(arguments: argparse.Namespace) -> int:
    from snakesim_operator.base import extras

    if arguments.format in ("parquet", "lerobot"):
        extras.require("report", f"--format {arguments.format}")
    from snakesim_operator.playback.export import export, export_dataset

    if arguments.format == "lerobot":
        choice = {"images": arguments.images, "task": arguments.task, "fps": arguments.fps}
        return export_dataset(arguments.recordings, arguments.out, print_line, **choice)
    if arguments.images or arguments.task is not None or arguments.fps is not None:
        raise ConfigError(
            f"--images, --task and --fps are for --format lerobot, not {arguments.format}; leave them out",
            code="command/conflicting-options",
        )
    return export(arguments.recordings, arguments.format, arguments.out, print_line)


def _replay(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.scenario import Override, parse_set
    from snakesim_operator.playback.control import replay_control
    from snakesim_operator.playback.play import play
    from snakesim_operator.results.run_reader import find_recording

    path = find_recording(arguments.recording)
    if arguments.control:
        overrides = [parse_set(text) for text in arguments.set]
        if arguments.controller is not None:
            overrides.append(Override("controller", arguments.controller, "--controller"))
        trusted = arguments.run_recorded_code
        return replay_control(path, overrides, arguments.out, print_line, run_recorded_code=trusted)
    if arguments.set or arguments.out or arguments.controller or arguments.run_recorded_code:
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
            rate=arguments.rate,
            step=arguments.step,
        )
    except KeyboardInterrupt:
        return 130
