"""The log of emulated drives has one line for each change."""

import io
import json

from snakesim_drivers.emulation.emulator_control import LOGGED_STEP_RAD, DriveLog, TrueState


def test_drive_log_has_a_line_for_each_change():
    file = io.StringIO()
    log = DriveLog(file)
    for enabled, angle_rad in [
        (False, 0.0),
        (False, 0.0),
        (True, 0.0),
        (True, LOGGED_STEP_RAD),
        (False, 0.1),
    ]:
        log.write(TrueState([enabled], [angle_rad]))
    lines = [json.loads(line) for line in file.getvalue().splitlines()]
    assert [line["enabled"] for line in lines] == [[False], [True], [True], [False]]
    assert [line["angle_rad"] for line in lines] == [[0.0], [0.0], [0.001], [0.1]]
    times_ns = [line["monotonic_ns"] for line in lines]
    assert times_ns == sorted(times_ns)
