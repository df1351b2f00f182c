"""Standing still: when it is noticed, and what it is put down to."""

import msgspec
import pytest

from snakesim_gnc.control.contact_forces import MeasuredContacts, NetContactForce
from snakesim_gnc.control.obstacle_triplet.stall import StallDetector, explain_stall
from snakesim_hal.wire.messages import WorldModel
from snakesim_testing.gnc.stage import make_contact, make_world, require_value


def watch() -> StallDetector:
    return StallDetector(stall_m=0.005, stall_s=1.0, propulsion_n=35.0)


def stalled_after(stall_watch, seconds, *, speed_m_s=0.0, force_n=35.0) -> float | None:
    for tick in range(round(seconds * 100) + 1):
        if stall_watch.has_stalled(tick * 0.01, speed_m_s * tick * 0.01, force_n):
            return tick * 0.01
    return None


def test_standing_is_noticed_after_the_window():
    assert stalled_after(watch(), 2.0) == pytest.approx(1.0)


def test_moving_or_not_pushing_is_no_stall():
    assert stalled_after(watch(), 5.0, speed_m_s=0.006) is None
    assert stalled_after(watch(), 5.0, force_n=17.0) is None


def test_forgetting_starts_a_new_window():
    stall_watch = watch()
    stalled_after(stall_watch, 0.9)
    stall_watch.reset()
    assert stalled_after(stall_watch, 0.9) is None


def world_with(*forces: tuple[str, float, float], timestamp_ns: int = 1) -> WorldModel:
    """Contacts with these forces in x and y."""
    contacts = [make_contact(name, (ahead_n, across_n, 0.0)) for name, ahead_n, across_n in forces]
    return make_world(contacts=contacts, contacts_timestamp_ns=timestamp_ns)


def along(*forces: tuple[str, float, float]) -> NetContactForce:
    """What contacts with these forces along and across the direction do."""
    felt = MeasuredContacts()
    felt.add_world(world_with(*forces))
    return require_value(felt.resolve_along((2.0, 0.0)))


# As a triplet of 30 N is.
PUSHED = ("peg_0", 0.0, 8.0), ("peg_1", 30.0, -40.0), ("peg_2", -0.5, 20.0)


def cause(**more):
    given = {
        "desired_force_n": 35.0,
        "force_n": 30.0,
        "net_force": along(*PUSHED),
        "push_points": ("peg_0", "peg_1", "peg_2"),
        "weight_n": 400.0,
        "saturated_joint": None,
        "swung_out_joint": None,
        "jam_force_n": 60.0,
        "drag_ratio": 0.5,
    }
    return explain_stall(**{**given, **more})


def test_stall_contacts_that_carry_load_are_no_jam():
    stall = cause()
    assert not stall.is_jammed
    assert not stall.should_release_triplet
    assert stall.reason == (
        "standing still with 30.0 N of propulsion; contacts push it on with 29.5 N, too little against the friction of "
        "the ground; raise propulsion_n"
    )


def test_a_push_point_that_is_not_felt_is_named():
    stall = cause(net_force=along(PUSHED[0], ("peg_1", 3.2, -4.0)))
    assert not stall.is_jammed
    assert "contacts push it on with 3.2 N (no contact at peg_2), too little" in stall.reason


@pytest.mark.parametrize("saturated_joint", [None, "joint_7"])
@pytest.mark.parametrize("desired_force_n", [8.0, 35.0, 300.0])
def test_a_body_that_touches_nothing_is_not_jammed(desired_force_n, saturated_joint):
    stall = cause(
        desired_force_n=desired_force_n,
        net_force=along(),
        weight_n=40.0,
        saturated_joint=saturated_joint,
    )
    assert not stall.is_jammed
    assert not stall.should_release_triplet
    assert "no obstacle touches the body" in stall.reason


def test_without_a_sensor_of_contacts_the_cause_is_unknown():
    stall = cause(net_force=None, weight_n=40.0)
    assert not stall.is_jammed
    assert stall.should_release_triplet
    assert stall.reason.endswith("what holds it is unknown without a sensor of contacts")


def test_a_jam_is_what_obstacles_hold_back():
    stall = cause(net_force=along(*PUSHED, ("post", -28.0, 60.0)))
    assert stall.is_jammed
    assert stall.reason == (
        "jammed: standing still with 30.0 N of propulsion; obstacles push it on with 30 N and hold it back with 28 N, "
        "post most"
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"net_force": along(*PUSHED, ("post", 0.0, 300.0))}, ""),
        (
            {"saturated_joint": "joint_7"},
            "contacts push it on with 29.5 N, too little against the friction of the ground; "
            "joint_7 at its limit of torque gives no more of the 35.0 N desired",
        ),
        ({"weight_n": 40.0}, ""),
        (
            {"swung_out_joint": "joint_5"},
            "joint_5 has swung out and leaves no more of the 35.0 N desired",
        ),
    ],
)
def test_stall_straining_body_that_stands_is_released_without_jam(given, words):
    stall = cause(**given)
    assert stall.should_release_triplet
    assert not stall.is_jammed
    assert words in stall.reason
    assert not stall.reason.startswith("jam")


def test_forces_are_judged_as_means_over_50_ms():
    felt = MeasuredContacts()
    for turn in range(9):
        felt.add_world(
            world_with(
                ("peg_0", 50.0 if turn % 5 == 0 else 0.0, 0.0), timestamp_ns=turn * 10_000_000
            )
        )
    net_force = require_value(felt.resolve_along((1.0, 0.0)))
    assert net_force.max_contact_n == pytest.approx(10.0)
    assert net_force.forward_n == pytest.approx(10.0)


def test_estimated_contacts_are_no_measured_forces():
    felt, world = MeasuredContacts(), world_with(*PUSHED)
    felt.add_world(world)
    felt.add_world(
        msgspec.structs.replace(world, contacts_timestamp_ns=2, contacts_from="joint_torques")
    )
    assert felt.resolve_along((1.0, 0.0)) is None
    assert felt.compute_mean_magnitudes_n(["peg_1"]) == []
