"""Tests when a stall of `obstacle_triplet` is detected, and which cause its explanation gives."""

import msgspec
import pytest

from snakesim_gnc.control.contact_forces import MeasuredContacts, NetContactForce
from snakesim_gnc.control.obstacle_triplet.stall import StallDetector, explain_stall
from snakesim_hal.wire.messages import WorldModel
from snakesim_testing.gnc.stage import make_contact, make_world, require_value

PERIOD_S = 0.01


def make_detector() -> StallDetector:
    return StallDetector(stall_m=0.005, stall_s=1.0, propulsion_n=35.0)


def find_stall_time_s(
    detector: StallDetector, duration_s: float, *, speed_m_s=0.0, force_n=35.0
) -> float | None:
    """Return when the detector reports a stall of a body at constant speed, or None within the duration."""
    for tick in range(round(duration_s * 100) + 1):
        time_s = tick * PERIOD_S
        if detector.has_stalled(time_s, speed_m_s * tick * PERIOD_S, force_n):
            return time_s
    return None


def test_stall_detector_reports_standing_body_after_its_window():
    assert find_stall_time_s(make_detector(), 2.0) == pytest.approx(1.0)


def test_stall_detector_of_moving_or_idle_body_reports_nothing():
    assert find_stall_time_s(make_detector(), 5.0, speed_m_s=0.006) is None
    assert find_stall_time_s(make_detector(), 5.0, force_n=17.0) is None


def test_stall_detector_reset_starts_a_new_window():
    detector = make_detector()
    find_stall_time_s(detector, 0.9)
    detector.reset()
    assert find_stall_time_s(detector, 0.9) is None


def make_world_with_forces(*forces: tuple[str, float, float], timestamp_ns: int = 1) -> WorldModel:
    """Return a world model with contacts that have these obstacles and forces along x and y."""
    contacts = [make_contact(name, (x_n, y_n, 0.0)) for name, x_n, y_n in forces]
    return make_world(contacts=contacts, contacts_timestamp_ns=timestamp_ns)


def compute_net_force(*forces: tuple[str, float, float]) -> NetContactForce:
    """Return the net force of contacts with these obstacles and forces along and across the path."""
    contacts = MeasuredContacts()
    contacts.add_world(make_world_with_forces(*forces))
    return require_value(contacts.resolve_along((2.0, 0.0)))


# Contacts of a triplet that pushes with 30 N: obstacle, and force in N along and across the path.
TRIPLET_FORCES = (("peg_0", 0.0, 8.0), ("peg_1", 30.0, -40.0), ("peg_2", -0.5, 20.0))


def explain(**changes):
    """Explain a stall of a triplet that pushes with 30 N, with changes of its circumstances."""
    circumstances = {
        "desired_force_n": 35.0,
        "force_n": 30.0,
        "net_force": compute_net_force(*TRIPLET_FORCES),
        "push_points": ("peg_0", "peg_1", "peg_2"),
        "weight_n": 400.0,
        "saturated_joint": None,
        "swung_out_joint": None,
        "jam_force_n": 60.0,
        "drag_ratio": 0.5,
    }
    return explain_stall(**{**circumstances, **changes})


def test_stall_contacts_that_carry_load_are_no_jam():
    stall = explain()
    assert not stall.is_jammed
    assert not stall.should_release_triplet
    assert stall.reason == (
        "standing still with 30.0 N of propulsion; contacts push it on with 29.5 N, too little against the friction of "
        "the ground; raise propulsion_n"
    )


def test_stall_reason_names_push_point_without_contact():
    stall = explain(net_force=compute_net_force(TRIPLET_FORCES[0], ("peg_1", 3.2, -4.0)))
    assert not stall.is_jammed
    assert "contacts push it on with 3.2 N (no contact at peg_2), too little" in stall.reason


@pytest.mark.parametrize("saturated_joint", [None, "joint_7"])
@pytest.mark.parametrize("desired_force_n", [8.0, 35.0, 300.0])
def test_stall_without_contacts_is_no_jam(desired_force_n, saturated_joint):
    stall = explain(
        desired_force_n=desired_force_n,
        net_force=compute_net_force(),
        weight_n=40.0,
        saturated_joint=saturated_joint,
    )
    assert not stall.is_jammed
    assert not stall.should_release_triplet
    assert "no obstacle touches the body" in stall.reason


def test_stall_without_contact_sensor_has_unknown_cause():
    stall = explain(net_force=None, weight_n=40.0)
    assert not stall.is_jammed
    assert stall.should_release_triplet
    assert stall.reason.endswith("what holds it is unknown without a sensor of contacts")


def test_stall_with_opposing_contact_forces_is_a_jam():
    stall = explain(net_force=compute_net_force(*TRIPLET_FORCES, ("post", -28.0, 60.0)))
    assert stall.is_jammed
    assert stall.reason == (
        "jammed: standing still with 30.0 N of propulsion; obstacles push it on with 30 N and hold it back with 28 N, "
        "post most"
    )


@pytest.mark.parametrize(
    ("circumstances", "expected_reason"),
    [
        ({"net_force": compute_net_force(*TRIPLET_FORCES, ("post", 0.0, 300.0))}, ""),
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
def test_stall_straining_body_that_stands_is_released_without_jam(circumstances, expected_reason):
    stall = explain(**circumstances)
    assert stall.should_release_triplet
    assert not stall.is_jammed
    assert expected_reason in stall.reason
    assert not stall.reason.startswith("jam")


def test_measured_contacts_are_averaged_over_50_ms():
    contacts = MeasuredContacts()
    for sample in range(9):
        force_n = 50.0 if sample % 5 == 0 else 0.0
        contacts.add_world(
            make_world_with_forces(("peg_0", force_n, 0.0), timestamp_ns=sample * 10_000_000)
        )
    net_force = require_value(contacts.resolve_along((1.0, 0.0)))
    assert net_force.max_contact_n == pytest.approx(10.0)
    assert net_force.forward_n == pytest.approx(10.0)


def test_measured_contacts_ignore_estimated_forces():
    contacts = MeasuredContacts()
    measured_world = make_world_with_forces(*TRIPLET_FORCES)
    estimated_world = msgspec.structs.replace(
        measured_world, contacts_timestamp_ns=2, contacts_from="joint_torques"
    )
    contacts.add_world(measured_world)
    contacts.add_world(estimated_world)
    assert contacts.resolve_along((1.0, 0.0)) is None
    assert contacts.compute_mean_magnitudes_n(["peg_1"]) == []
