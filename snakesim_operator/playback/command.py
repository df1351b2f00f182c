"""The commands for recordings: `snakesim info`, `report`."""

import argparse
from pathlib import Path
from typing import Any

from snakesim_hal.terminal import say


def add_commands(commands: Any) -> None:
    """Add them to the parser of `snakesim`."""
    info = commands.add_parser("info", help="print what a recording holds: keys, rates, sizes, gaps")
    _add_recording(info)
    info.add_argument("--json", action="store_true", help="print one JSON object")
    info.set_defaults(act=_info)

    report = commands.add_parser("report", help="write the page of a run anew, also from a recording alone")
    _add_recording(report)
    report.add_argument("--out", type=Path, metavar="FILE.html", help="the page (default: beside the recording)")
    report.set_defaults(act=_report)


def _add_recording(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", type=Path, metavar="RUN", help="folder of a run, or an MCAP file")


def _info(arguments: argparse.Namespace) -> int:
    from snakesim_operator.playback.info import show

    return show(arguments.recording, say, as_json=arguments.json)


def _report(arguments: argparse.Namespace) -> int:
    from snakesim_hal.model.whole_file import write_whole
    from snakesim_operator.results.record import REPORT, RunRecord
    from snakesim_operator.results.report import page
    from snakesim_operator.results.summary import summarise

    given: Path = arguments.recording
    record = RunRecord.load(given)
    out = arguments.out or (given / REPORT if given.is_dir() else given.with_suffix(".html"))
    write_whole(out, page(record, summarise(record, record.host.ended)).encode())
    say(str(out))
    return 0
