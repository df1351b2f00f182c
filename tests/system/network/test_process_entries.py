"""Processes of one robot that are set up differently do not arm it, and say where the difference is."""

import msgspec
import pytest

from snakesim_hal.model.scenario import RunConfig, load, parse_set
from snakesim_hal.network.process_entries import ProcessEntries, own_entry, show_process
from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Process
from snakesim_testing.harness.wait import wait_until


def config(*sets: str) -> RunConfig:
    return load("triplet", [parse_set(text) for text in sets]).config


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("robot.limits.speed_rad_s=3.0", "`robot` is planar13 "),
        ("scene.ground.friction=0.2", "`scene` is triplet "),
        ("rate_hz=50", "`rate_hz` is 50 on "),
        ("clock_mode=realtime", "`clock_mode` is realtime on "),
        ("services.control.latency_ticks=3", "`services` is "),
        ("control.propulsion_n=30.0", "`controller` is obstacle_triplet "),
        ("mission.speed_m_s=0.2", "`mission` is "),
    ],
)
def test_a_difference_is_told_with_both_places(change: str, named: str, sessions: tuple[Session, Session]) -> None:
    here, there = sessions
    entries, own = ProcessEntries(here), own_entry("host", config())
    show_process(there, own_entry("control", config(change)))
    wait_until(lambda: bool(entries.find_problems(own, ["control"])), "an entry", 5.0)
    wait_until(lambda: named in entries.find_problems(own, ["control"])[0], named, 5.0)
    (reported,) = entries.find_problems(own, ["control"])
    assert f"(control, process {own.pid})" in reported
    assert f"(host, process {own.pid})" in reported
    assert entries.find_problems(own, ["guidance"]) == []


def test_what_only_one_of_them_uses_may_differ(sessions: tuple[Session, Session]) -> None:
    here, there = sessions
    entries, own = ProcessEntries(here), own_entry("host", config())
    service = own_entry(
        "control", config("backend=can", "duration_s=3", "title=another", "services.control.restart=false")
    )
    show_process(there, service)
    show_process(there, msgspec.structs.replace(service, name="recorder", settings={}, messages={}))
    wait_until(lambda: len(here.present(keys.PROCESS_ALL)) == 2, "both", 5.0)
    wait_until(lambda: entries.find_problems(own, ["control", "recorder"]) == [], "no difference", 5.0)


def test_process_entry_with_other_version_is_reported_while_alive(
    sessions: tuple[Session, Session],
) -> None:
    here, there = sessions
    entries, own = ProcessEntries(here), own_entry("host", config())
    key = keys.process_key("control", "1")
    there.declare_token(key)
    wait_until(
        lambda: entries.find_problems(own, ["control"]) == ["control-1 has not published its settings yet"],
        "a token",
        5.0,
    )
    newer = msgspec.structs.replace(own, name="control", messages={**own.messages, "JointCommand": 2, "Leap": 1})
    there.latched_publisher(key, Process).put(newer)
    wait_until(
        lambda: "message JointCommand has version 2 on " in "".join(entries.find_problems(own, ["control"])),
        "told",
        5.0,
    )
    there.close()
    wait_until(lambda: entries.find_problems(own, ["control"]) == [], "gone", 5.0)
