"""A robot is not armed if its processes have different configurations, and the refusal names each difference."""

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

TIMEOUT_S = 5.0


def load_config(*options: str) -> RunConfig:
    """Load the scenario `triplet` with options as `--set` takes them."""
    return load_scenario("triplet", [parse_set_option(text) for text in options]).config


@pytest.mark.parametrize(
    ("change", "reported_difference"),
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
def test_process_entries_difference_is_reported_with_key_and_both_values(
    change: str, reported_difference: str, sessions: tuple[Session, Session]
) -> None:
    host, service = sessions
    entries = ProcessEntries(host)
    host_entry = make_own_entry("host", load_config())
    publish_process_entry(service, make_own_entry("control", load_config(change)))
    wait_until(lambda: bool(entries.find_problems(host_entry, ["control"])), "an entry", TIMEOUT_S)
    wait_until(
        lambda: reported_difference in entries.find_problems(host_entry, ["control"])[0],
        reported_difference,
        TIMEOUT_S,
    )
    (problem,) = entries.find_problems(host_entry, ["control"])
    assert f"(control, process {host_entry.pid}) differs from this host in `" in problem
    assert "; start " in problem
    assert entries.find_problems(host_entry, ["guidance"]) == []


@pytest.mark.parametrize(
    ("backend", "driver"), [("dynamixel", ""), ("moteus", ""), ("can", ""), ("mixed", "dynamixel")]
)
def test_process_entries_modes_missing_in_backend_are_no_difference(
    backend: str, driver: str
) -> None:
    """The host leaves these modes out of its configuration, and a service does not know the backend."""
    common_options = ("clock_mode=realtime", f'robot.drive.driver="{driver}"')
    service_config = load_config(*common_options)
    host_config = validate_backend_config(load_config(*common_options, f"backend={backend}"))
    service_entry = make_own_entry("control", service_config)
    host_entry = make_own_entry("host", host_config)
    assert describe_differences(service_entry, host_entry) == []


def test_process_entries_settings_used_by_one_process_may_differ(
    sessions: tuple[Session, Session],
) -> None:
    host, other_process = sessions
    entries = ProcessEntries(host)
    host_entry = make_own_entry("host", load_config())
    service_entry = make_own_entry(
        "control",
        load_config(
            "backend=can", "duration_s=3", "title=another", "services.control.restart=false"
        ),
    )
    recorder_entry = msgspec.structs.replace(
        service_entry, name="recorder", settings={}, messages={}
    )
    publish_process_entry(other_process, service_entry)
    publish_process_entry(other_process, recorder_entry)
    wait_until(lambda: len(host.list_tokens(keys.PROCESS_ALL)) == 2, "both entries", TIMEOUT_S)
    wait_until(
        lambda: entries.find_problems(host_entry, ["control", "recorder"]) == [],
        "no difference",
        TIMEOUT_S,
    )


def test_process_entry_with_other_version_is_reported_while_alive(
    sessions: tuple[Session, Session],
) -> None:
    host, service = sessions
    entries = ProcessEntries(host)
    host_entry = make_own_entry("host", load_config())

    def find_problems() -> list[str]:
        return entries.find_problems(host_entry, ["control"])

    key = keys.process_key("control", "1")
    service.declare_token(key)
    wait_until(
        lambda: find_problems() == ["control-1 has not published its settings yet"],
        "a token",
        TIMEOUT_S,
    )
    same_entry = msgspec.structs.replace(host_entry, name="control")
    newer_entry = msgspec.structs.replace(
        same_entry, messages={**host_entry.messages, "JointCommand": 2, "Leap": 1}
    )
    publisher = service.declare_latched_publisher(key, ProcessInfo)
    publisher.put(newer_entry)
    wait_until(
        lambda: "message JointCommand version 2 (here " in "".join(find_problems()),
        "the difference",
        TIMEOUT_S,
    )
    publisher.put(same_entry)
    wait_until(lambda: find_problems() == [], "no difference any more", TIMEOUT_S)
    publisher.put(newer_entry)
    wait_until(lambda: find_problems() != [], "the difference again", TIMEOUT_S)
    service.close()
    wait_until(lambda: find_problems() == [], "the process is gone", TIMEOUT_S)
