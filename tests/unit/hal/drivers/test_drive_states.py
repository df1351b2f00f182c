"""Which commands a drive gets again, and when a drive that does not switch on is reported."""

import pytest

from snakesim_drivers.kit.drive_states import DriveCommand, DriveStates

PERIOD_NS = 20_000_000
ALL_DRIVES = frozenset({0})


class SlowDrive:
    """A drive that takes some periods to switch on, and the states that its driver keeps of it."""

    def __init__(self, enable_periods: int, max_enable_s: float | None) -> None:
        self._enable_periods = enable_periods
        self._now_ns = 0
        self.states = DriveStates(["joint_1"], PERIOD_NS, lambda: self._now_ns, max_enable_s)

    def switch_on(self) -> list[DriveCommand]:
        """Switch the drive on, let it report in every period until it is on, and return its commands."""
        commands: list[DriveCommand] = []
        for period in range(self._enable_periods + 1):
            self._now_ns += PERIOD_NS
            is_on = period == self._enable_periods
            self.states.record_report(0, enabled=is_on, state="standby")
            new_commands = self.states.update_commands(ALL_DRIVES, emergency=False)
            commands.extend(command for _, command in new_commands)
            if self.states.list_findings():
                break
        return commands


@pytest.mark.parametrize(
    ("enable_periods", "max_enable_s", "causes"),
    [
        (4, None, []),
        (10, None, ["joint_1 does not follow: it is standby"]),
        (10, 0.3, []),
        (30, 0.3, ["joint_1 does not follow: it is standby"]),
    ],
    ids=["quick", "slow", "slow as stated", "slower than stated"],
)
def test_drive_is_reported_if_it_switches_on_too_slowly(
    enable_periods: int, max_enable_s: float | None, causes: list[str]
) -> None:
    drive = SlowDrive(enable_periods, max_enable_s)
    drive.switch_on()
    assert [finding.cause for finding in drive.states.list_findings()] == causes


def test_drive_gets_its_command_again_until_it_is_on() -> None:
    commands = SlowDrive(enable_periods=10, max_enable_s=0.3).switch_on()
    assert set(commands) == {"follow"}
    assert len(commands) == 9
