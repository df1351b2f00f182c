"""Processes of one robot that are set up differently do not arm it, and say where the difference is."""

import msgspec
import pytest

from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.network.process_entries import (
    ProcessEntries,
    describe_differences,
    make_own_entry,
    publish_process_entry,
)
from snakesim_hal.network.session import Session
from snakesim_hal.programs.preflight import validate_backend_config
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ProcessInfo
from snakesim_testing.harness.wait import wait_until


def config(*sets: str) -> RunConfig:
    return load_scenario("triplet", [parse_set_option(text) for text in sets]).config


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("robot.limits.speed_rad_s=3.0", "`robot.limits.speed_rad_s` = 3.0 (here 7.5)"),
        ("robot.joints.joint_2.id=40", '`robot.joints.joint_2` = {"id": 40} (here not set)'),
        ("scene.ground.friction=0.2", "`scene.ground.friction` = 0.2 (here 0.1)"),
        ("rate_hz=50", "`rate_hz` = 50.0 (here 100.0)"),
        (
            "clock_mode=realtime",
            "`clock_mode` = realtime (here lockstep); start control again with --clock-mode lock",
        ),
        ("services.control.latency_ticks=3", "`services.control.latency_ticks` = 3 (here 2)"),
        (
            "control.propulsion_n=30.0",
            "`controllers.obstacle_triplet.propulsion_n` = 30.0 (here 35.0)",
        ),
        ("mission.speed_m_s=0.2", "`mission.speed_m_s` = 0.2 (here 0.1)"),
    ],
)
def test_a_difference_is_reported_with_its_key_and_both_values(
    change: str, named: str, sessions: tuple[Session, Session]
) -> None:
    here, there = sessions
    entries, own = ProcessEntries(here), make_own_entry("host", config())
    publish_process_entry(there, make_own_entry("control", config(change)))
    wait_until(lambda: bool(entries.find_problems(own, ["control"])), "an entry", 5.0)
    wait_until(lambda: named in entries.find_problems(own, ["control"])[0], named, 5.0)
    (reported,) = entries.find_problems(own, ["control"])
    assert f"(control, process {own.pid}) differs from this host in `" in reported
    assert "; start " in reported
    assert entries.find_problems(own, ["guidance"]) == []


@pytest.mark.parametrize(
    ("backend", "driver"), [("dynamixel", ""), ("moteus", ""), ("can", ""), ("mixed", "dynamixel")]
)
def test_modes_that_a_backend_does_not_have_are_no_difference(backend: str, driver: str) -> None:
    """The host leaves them out of its configuration, and a service does not know the backend."""
    both = ("clock_mode=realtime", f'robot.drive.driver="{driver}"')
    of_service = config(*both)
    of_host = validate_backend_config(config(*both, f"backend={backend}"))
    assert (
        describe_differences(make_own_entry("control", of_service), make_own_entry("host", of_host))
        == []
    )


def test_what_only_one_of_them_uses_may_differ(sessions: tuple[Session, Session]) -> None:
    here, there = sessions
    entries, own = ProcessEntries(here), make_own_entry("host", config())
    service = make_own_entry(
        "control",
        config("backend=can", "duration_s=3", "title=another", "services.control.restart=false"),
    )
    publish_process_entry(there, service)
    publish_process_entry(
        there, msgspec.structs.replace(service, name="recorder", settings={}, messages={})
    )
    wait_until(lambda: len(here.list_tokens(keys.PROCESS_ALL)) == 2, "both", 5.0)
    wait_until(
        lambda: entries.find_problems(own, ["control", "recorder"]) == [], "no difference", 5.0
    )


def test_process_entry_with_other_version_is_reported_while_alive(
    sessions: tuple[Session, Session],
) -> None:
    here, there = sessions
    entries, own = ProcessEntries(here), make_own_entry("host", config())
    key = keys.process_key("control", "1")
    there.declare_token(key)
    wait_until(
        lambda: (
            entries.find_problems(own, ["control"])
            == ["control-1 has not published its settings yet"]
        ),
        "a token",
        5.0,
    )
    newer = msgspec.structs.replace(
        own, name="control", messages={**own.messages, "JointCommand": 2, "Leap": 1}
    )
    shown = there.declare_latched_publisher(key, ProcessInfo)
    shown.put(newer)
    wait_until(
        lambda: (
            "message JointCommand version 2 (here "
            in "".join(entries.find_problems(own, ["control"]))
        ),
        "the difference",
        5.0,
    )
    shown.put(msgspec.structs.replace(own, name="control"))
    wait_until(lambda: entries.find_problems(own, ["control"]) == [], "no difference any more", 5.0)
    shown.put(newer)
    wait_until(lambda: entries.find_problems(own, ["control"]) != [], "the difference again", 5.0)
    there.close()
    wait_until(lambda: entries.find_problems(own, ["control"]) == [], "gone", 5.0)
