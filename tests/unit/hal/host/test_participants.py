"""The end of a lockstep tick waits only for services that answer this tick."""

import pytest

from snakesim_hal.host.participants import LockstepParticipants
from snakesim_hal.model.scenario import ServiceSchedule

SERVICES = {
    "navigation": ServiceSchedule(decimation=4, latency_ticks=2),
    "control": ServiceSchedule(),
}


def test_service_that_connects_at_tick_zero_is_awaited_there() -> None:
    participants = LockstepParticipants(SERVICES)
    participants.mark_present("control", 0)
    assert participants.find_services_behind(0) == ["control"]
    participants.mark_done("control", 0)
    assert participants.find_services_behind(0) == []
    assert participants.find_services_behind(1) == ["control"]


def test_service_is_not_awaited_for_ticks_before_it_connected() -> None:
    """Avoid a deadlock: the service waits for the next clock, and never receives the present one."""
    participants = LockstepParticipants(SERVICES)
    participants.mark_present("control", 8)  # it connects while the host waits at the end of tick 7
    assert participants.find_services_behind(7) == []
    assert participants.find_services_behind(8) == ["control"]


@pytest.mark.parametrize(("next_tick", "awaited_from"), [(5, 9), (8, 9), (9, 13)])
def test_service_with_decimation_is_awaited_from_first_due_tick(
    next_tick: int, awaited_from: int
) -> None:
    """Check that the end of tick 9 needs the answer to tick 8: decimation 4, latency 2 ticks."""
    participants = LockstepParticipants(SERVICES)
    participants.mark_present("navigation", next_tick)
    assert [tick for tick in range(16) if participants.find_services_behind(tick)] == list(
        range(awaited_from, 16)
    )


def test_second_token_of_a_connected_service_changes_nothing() -> None:
    participants = LockstepParticipants(SERVICES)
    participants.mark_present("control", 3)
    participants.mark_present("control", 9)
    assert participants.find_services_behind(3) == ["control"]


def test_service_that_reconnects_is_awaited_from_next_tick() -> None:
    participants = LockstepParticipants(SERVICES)
    participants.mark_present("control", 0)
    participants.mark_done("control", 4)
    assert participants.mark_absent("control")
    assert participants.find_services_behind(5) == []
    participants.mark_present("control", 6)
    assert participants.find_services_behind(5) == []
    assert participants.find_services_behind(6) == ["control"]
