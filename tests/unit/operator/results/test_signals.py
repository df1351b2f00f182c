"""Signals that are computed from a record: contact forces, and the motion of the whole body."""

import dataclasses

import numpy as np
import pytest

from snakesim_hal.wire import messages as m
from snakesim_operator.results.contact_log import (
    MAX_OBSTACLES,
    OTHER,
    UNIDENTIFIED,
    ContactCollector,
)
from snakesim_operator.results.metrics.directions import measure_slip
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import (
    UNITS,
    compute_signals,
    find_unit,
    list_component_names,
    make_signal_columns,
    select_columns,
)
from snakesim_operator.results.signals.contact_forces import compute_contact_signals
from snakesim_operator.results.signals.motion import compute_motion_signals
from snakesim_operator.results.summary import RunSummary, summarize_run

SPEED_M_S = 0.2
YAW_RAD = 0.5


def make_contact(link: int, obstacle: str | None, force_l: tuple[float, float, float]) -> m.Contact:
    """Make a contact with this force in the frame of its link."""
    return m.Contact(
        link=link,
        obstacle=obstacle,
        position_l=(0.0, 0.0, 0.0),
        normal_l=(0.0, 1.0, 0.0),
        tangent_1_l=(1.0, 0.0, 0.0),
        tangent_2_l=(0.0, 0.0, 1.0),
        force_l=force_l,
        torque_l=(0.0, 0.0, 0.0),
    )


def make_straight_run(
    record: RunRecord, direction_rad: float, turn_rate_rad_s: float = 0.0
) -> RunRecord:
    """Return a run of a straight body that first heads along YAW_RAD, and travels at SPEED_M_S in a direction."""
    time_s = record.time_s - record.time_s[0]
    position_w = np.zeros_like(record.position_w_m)
    position_w[:, 0] = SPEED_M_S * time_s * np.cos(direction_rad)
    position_w[:, 1] = SPEED_M_S * time_s * np.sin(direction_rad)
    half_yaw_rad = 0.5 * (YAW_RAD + turn_rate_rad_s * time_s)
    orientation = np.zeros_like(record.orientation_wxyz)
    orientation[:, 0] = np.cos(half_yaw_rad)
    orientation[:, 3] = np.sin(half_yaw_rad)
    angle_rad = np.zeros_like(record.angle_rad)
    return dataclasses.replace(
        record, position_w_m=position_w, orientation_wxyz=orientation, angle_rad=angle_rad
    )


def test_signal_velocity_is_in_world_and_body_frame(record: RunRecord) -> None:
    sideways = make_straight_run(record, YAW_RAD + np.pi / 2)
    motion = compute_motion_signals(sideways)
    tick_count = len(record.time_s)
    expected_w = SPEED_M_S * np.array([-np.sin(YAW_RAD), np.cos(YAW_RAD), 0.0])
    assert motion["velocity_w_m_s"] == pytest.approx(np.tile(expected_w, (tick_count, 1)), abs=1e-9)
    expected_b = [0.0, SPEED_M_S, 0.0]
    assert motion["velocity_b_m_s"] == pytest.approx(np.tile(expected_b, (tick_count, 1)), abs=1e-9)
    assert motion["heading_w_rad"] == pytest.approx(np.full(tick_count, YAW_RAD))


def test_signal_turn_rate_has_no_jump_at_half_a_turn(record: RunRecord) -> None:
    motion = compute_motion_signals(make_straight_run(record, 0.0, turn_rate_rad_s=1.0))
    assert motion["turn_rate_rad_s"] == pytest.approx(np.ones(len(record.time_s)))


def test_signal_velocity_ignores_gaps_between_ticks(record: RunRecord) -> None:
    run = make_straight_run(record, 0.0)
    time_s = run.time_s.copy()
    time_s[500:] += 2.0  # after a gap of two seconds the motion continues at the same place
    velocity_w = compute_motion_signals(dataclasses.replace(run, time_s=time_s))["velocity_w_m_s"]
    assert velocity_w[:, 0] == pytest.approx(np.full(len(time_s), SPEED_M_S))


def test_signal_body_frame_is_unknown_if_head_touches_tail(record: RunRecord) -> None:
    angle_rad = np.zeros_like(record.angle_rad)
    angle_rad[:, len(record.description.links) // 2 - 1] = np.pi  # the body is folded in the middle
    motion = compute_motion_signals(
        dataclasses.replace(make_straight_run(record, 0.0), angle_rad=angle_rad)
    )
    assert np.isnan(motion["heading_w_rad"]).all()
    assert np.isnan(motion["velocity_b_m_s"]).all()
    assert np.isfinite(motion["velocity_w_m_s"]).all()


def test_signal_forces_add_up_on_links_and_obstacles(record: RunRecord) -> None:
    collector = ContactCollector()
    first_tick = int(record.ticks[0])
    contacts = [
        make_contact(0, "peg_2", (0.0, 3.0, 0.0)),
        make_contact(0, "peg_10", (4.0, 0.0, 0.0)),
        make_contact(5, "peg_2", (0.0, 1.0, 0.0)),
        make_contact(2, None, (0.0, 0.0, 2.0)),
        make_contact(60, "peg_2", (9.0, 9.0, 9.0)),  # no link of this robot
    ]
    collector.add_sample(m.Contacts(tick=first_tick + 2, timestamp_ns=0, contacts=contacts))
    collector.add_sample(m.Contacts(tick=first_tick + 4, timestamp_ns=0, contacts=[]))
    run = dataclasses.replace(make_straight_run(record, 0.0), contact_log=collector.make_log())
    forces = compute_contact_signals(run)

    assert np.isnan(forces["link_force_n"][:2]).all()
    assert forces["link_force_l_n"][2, 0].tolist() == [4.0, 3.0, 0.0]
    assert forces["link_force_n"][3, 0] == 5.0  # the newest sample counts
    assert (forces["link_force_n"][4:] == 0.0).all()
    assert list_component_names("obstacle_force_n", run) == ["peg_2", "peg_10", UNIDENTIFIED]
    assert forces["obstacle_force_n"][2].tolist() == pytest.approx([4.0, 4.0, 2.0])
    left_w = [-np.sin(YAW_RAD), np.cos(YAW_RAD), 0.0]
    assert forces["obstacle_force_w_n"][2, 0] == pytest.approx(4.0 * np.array(left_w))
    columns = make_signal_columns(run)
    assert columns["obstacle_force_n.peg_10"][2] == pytest.approx(4.0)
    assert list(select_columns("link_force_l_n.link_5", columns)) == [
        f"link_force_l_n.link_5.{axis}" for axis in "xyz"
    ]


def test_signal_obstacle_force_without_pose_has_magnitude_only(record: RunRecord) -> None:
    collector = ContactCollector()
    contacts = [make_contact(1, "peg", (0.0, 3.0, 4.0))]
    collector.add_sample(m.Contacts(tick=int(record.ticks[0]), timestamp_ns=0, contacts=contacts))
    without_pose = dataclasses.replace(
        record,
        position_w_m=np.full_like(record.position_w_m, np.nan),
        contact_log=collector.make_log(),
    )
    forces = compute_contact_signals(without_pose)
    assert forces["obstacle_force_n"][0, 0] == pytest.approx(5.0)
    assert np.isnan(forces["obstacle_force_w_n"]).all()


def test_signal_obstacle_column_count_is_bounded() -> None:
    collector = ContactCollector()
    contacts = [make_contact(0, f"peg_{i}", (1.0, 0.0, 0.0)) for i in range(MAX_OBSTACLES + 20)]
    for tick, contact in enumerate(contacts):
        collector.add_sample(m.Contacts(tick=tick, timestamp_ns=0, contacts=[contact]))
    log = collector.make_log()
    assert len(log.obstacles) == MAX_OBSTACLES + 1
    assert OTHER in log.obstacles


def test_signal_strongest_link_force_exceeds_recorded_mean(record: RunRecord) -> None:
    """The contact sensor stores a mean over 50 ms, which cannot exceed the strongest force."""
    forces = compute_signals(record)["link_force_n"]
    assert np.nanmax(forces) >= np.nanmax(record.contact_peak_n) > 1.0


def test_signal_units_are_known_for_every_signal(record: RunRecord) -> None:
    for name in [*compute_signals(record), *make_signal_columns(record)]:
        assert find_unit(name, record) == UNITS[name.partition(".")[0]]


def summarize_body_moving_to_its_left(record: RunRecord) -> RunSummary:
    """Return the summary of a run of a straight body that moves to its left at SPEED_M_S."""
    left_rad = YAW_RAD + np.pi / 2  # the body heads along YAW_RAD
    return summarize_run(make_straight_run(record, direction_rad=left_rad), "complete")


def test_summary_sideways_motion_is_no_advance_along_heading(record: RunRecord) -> None:
    summary = summarize_body_moving_to_its_left(record)
    assert summary.heading_advance_m == pytest.approx(0.0, abs=1e-6)
    assert summary.heading_energy_j_per_m is None, "energy for each meter of an advance of 0 m"


def test_summary_sideways_motion_is_displacement_to_the_left(record: RunRecord) -> None:
    summary = summarize_body_moving_to_its_left(record)
    left_of_heading_rad = np.pi / 2
    assert summary.displacement_m_s == pytest.approx(SPEED_M_S, rel=0.01)
    assert summary.displacement_bearing_rad == pytest.approx(left_of_heading_rad)


def test_summary_sideways_motion_costs_energy_along_the_displacement(record: RunRecord) -> None:
    summary = summarize_body_moving_to_its_left(record)
    weight_n = 9.81 * sum(link.mass_kg for link in record.description.links)
    friction_n = record.config.scene.ground.friction * weight_n
    assert summary.energy_j is not None
    assert summary.net_displacement_m is not None

    energy_j_per_m = summary.energy_j / summary.net_displacement_m
    assert summary.displacement_energy_j_per_m == pytest.approx(energy_j_per_m)

    cost_of_transport = energy_j_per_m / weight_n
    assert summary.displacement_cost_of_transport == pytest.approx(cost_of_transport, rel=0.001)

    # Pulling the body over the ground takes the work of friction, in J for each meter.
    efficiency = friction_n / energy_j_per_m
    assert summary.displacement_efficiency == pytest.approx(efficiency, rel=0.001)


def test_summary_sideways_motion_is_lateral_slip_only(record: RunRecord) -> None:
    """All motion of the links is across their axes, and none of it is lost for the displacement."""
    summary = summarize_body_moving_to_its_left(record)
    assert summary.displacement_slip == pytest.approx(0.0, abs=1e-9)
    assert summary.lateral_slip == pytest.approx(1.0)


def test_summary_body_that_slides_back_slips(record: RunRecord) -> None:
    """The body slides forward for 7.5 s and back for 2.5 s, so it loses half of its path."""
    run = make_straight_run(record, YAW_RAD)
    position_w = run.position_w_m.copy()
    reversal = round(0.75 * len(position_w))
    farthest_w = position_w[reversal - 1]
    position_w[reversal:] = farthest_w - (position_w[reversal:] - farthest_w)
    summary = summarize_run(dataclasses.replace(run, position_w_m=position_w), "complete")
    assert summary.displacement_slip == pytest.approx(0.5, abs=0.02)
    assert summary.lateral_slip == pytest.approx(0.0, abs=1e-9)


def test_slip_of_stationary_body_is_unknown(record: RunRecord) -> None:
    run = make_straight_run(record, 0.0)
    stationary = dataclasses.replace(run, position_w_m=np.zeros_like(run.position_w_m))
    slip = measure_slip(stationary, 0.0)
    assert slip.longitudinal is None
    assert slip.lateral is None
