"""`snakesim record`: writes everything that a robot publishes into one MCAP file, beside whatever else runs there."""

import signal
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from snakesim_hal.base.process import on_stop_signal, stop_signals
from snakesim_hal.base.terminal import say
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.targets import RobotSelection, only_robot
from snakesim_operator.recording.live import LiveServer
from snakesim_operator.recording.process import record


def record_robot(
    where: RobotSelection,
    out: Path | None,
    duration_s: float | None,
    foxglove_port: int | None = None,
    foxglove_origins: Sequence[str] = (),
    *,
    raw_only: bool = False,
) -> int:
    """Record until Ctrl-C, or for a time by the wall clock. Exit code 1 when the disk took no more.

    foxglove_port: serve viewers there meanwhile; foxglove_origins: of web pages that may be such viewers;
    raw_only: the file is without topics for viewers.
    """
    link = replace(only_robot(where, "record"), max_bytes=MAX_IMAGE_BYTES)
    path = out or Path(f"{link.namespace}-{datetime.now():%Y%m%d-%H%M%S}.mcap")
    path.parent.mkdir(parents=True, exist_ok=True)
    stopped: list[bool] = []
    on_stop_signal(lambda: stopped.append(True))
    began = time.monotonic()
    try:
        with (
            nullcontext()
            if foxglove_port is None
            else LiveServer(link.namespace or "robot", foxglove_port, foxglove_origins, say) as live
        ):
            end = "" if duration_s else "; Ctrl-C ends it"
            say(f"recording {link.namespace} on {link.endpoint} into {path}{end}")
            if live is not None:
                say(f"Foxglove: open connection {live.address}")
            recorder = record(
                link,
                path,
                lambda: not stopped and (duration_s is None or time.monotonic() < began + duration_s),
                live.show if live is not None else None,
                raw_only=raw_only,
            )
    finally:
        for number in stop_signals():
            signal.signal(number, signal.SIG_DFL)
    messages, size = recorder.recording.counts.total(), path.stat().st_size
    say(f"{messages} messages in {time.monotonic() - began:.1f} s, {size / 1e6:.1f} MB: {path}")
    return 1 if recorder.recording.failure else 0
