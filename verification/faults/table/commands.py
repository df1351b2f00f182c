"""Rows about commands of a second controller, and commands that are late, replayed or malformed."""

from verification.faults.row import FaultHeading, FaultRow
from verification.faults.rows import commands, two_writers
from verification.faults.table.row_kinds import FRAMES_THROUGH, apply_to_sim_and_can

TWO_CONTROLLERS = FaultHeading(
    fault="two controllers",
    expected="the first controller keeps the lease. The second one gets a reason in the answer, and none of its "
    "commands passes in 100,000 interleavings",
    deadline="at once",
    rows=(
        FaultRow(
            name="two_controllers",
            fault="two writers at one limiter, interleaved by chance",
            expected="no setpoint and no right for the second",
            deadline="at once: with the call",
            limit=0.0,
            unit="frames from the second",
            measures={"both": two_writers.measure_interleaved_writers},
        ),
        FaultRow(
            name="second_controller",
            fault="a second controller on the network requests the lease, and commands with other epochs",
            expected="typed refusal (lease_held), commands refused as wrong_epoch, the first continues",
            deadline="at once: none applied",
            limit=0.0,
            unit="frames from the second",
            measures=apply_to_sim_and_can(commands.measure_second_controller),
        ),
    ),
)

COMMANDS_OUT_OF_TIME = FaultHeading(
    fault="a command is stale, replayed, reordered, duplicated or from the future",
    expected="the command is refused",
    deadline="one message",
    rows=(
        FaultRow(
            name="out_of_time",
            fault="commands out of their time, with the right lease epoch",
            expected="each refused and counted by its reason, the controller's own continue",
            deadline="one message: none applied",
            limit=0.0,
            unit=FRAMES_THROUGH,
            measures=apply_to_sim_and_can(commands.measure_out_of_time),
        ),
    ),
)

INVALID_COMMANDS = FaultHeading(
    fault="a command contains NaN, infinity, values out of range, a wrong length, a wrong joint order, malformed or "
    "huge bytes, or an unknown version",
    expected="the command is refused and counted. No exception leaves a callback",
    deadline="one message",
    rows=(
        FaultRow(
            name="wrong_in_itself",
            fault="commands that are wrong in themselves, with the right epoch, sequence and tick",
            expected="each refused and counted by its reason, the controller's own continue, no process ends",
            deadline="one message: none applied",
            limit=0.0,
            unit=FRAMES_THROUGH,
            measures=apply_to_sim_and_can(commands.measure_invalid_content),
        ),
    ),
)
