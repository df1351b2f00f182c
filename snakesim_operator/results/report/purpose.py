"""The result of a run that was not meant to locomote, in one sentence: of a joint check and of an identification."""

import numpy as np

from snakesim_hal.model.checked import CHECK
from snakesim_operator.results.record import RunRecord

NEXT = {  # controller -> command that judges its run
    CHECK: "snakesim joints check",
    "identify": "snakesim identify",
}
MOVED_RAD = 1e-3  # of a target; rounding moves it less


def purpose_of(record: RunRecord) -> tuple[bool, str] | None:
    """Return whether a run that was not meant to locomote served its purpose, and that in words; None for others."""
    command = NEXT.get(record.config.controller)
    if command is None:
        return None
    joints = [joint.name for joint in record.description.joints]
    if not len(record.target):
        return False, "No joint was moved: the robot was never armed."
    away_rad = np.abs(record.target - np.nanmedian(record.target, axis=0))
    moved = [name for name, way in zip(joints, np.nanmax(away_rad, axis=0), strict=True) if way > MOVED_RAD]
    if len(moved) == len(joints):
        return True, f"Every joint was moved. Judge the run with `{command} {record.folder}`."
    unmoved = ", ".join(name for name in joints if name not in moved)
    return False, f"Not moved: {unmoved}. Run it again with a longer --duration."
