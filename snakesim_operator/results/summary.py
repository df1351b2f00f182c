"""The numbers of a run, in one file that scripts can read: `summary.json`."""

from collections.abc import Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from snakesim_hal.base.arithmetic import find_differing_parts
from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_hal.wire.messages import ClockMode, ControlState, Fault, JointMode, TimingStatistics
from snakesim_operator.results.metrics.advance import (
    ForwardProgress,
    compute_center_of_mass_w,
    compute_energy_j,
    compute_energy_j_per_m,
    compute_work_j,
)
from snakesim_operator.results.metrics.directions import DisplacementMetrics, HeadingEffort
from snakesim_operator.results.metrics.effort import EffortMetrics
from snakesim_operator.results.metrics.estimates import EstimateMetrics
from snakesim_operator.results.metrics.force_tracking import measure_force_tracking
from snakesim_operator.results.metrics.motion import StopIntervals, find_stops
from snakesim_operator.results.metrics.propulsion import count_hand_overs, find_propulsion_periods
from snakesim_operator.results.run_log import RunRecord

SATURATION_RATIO = 0.99  # a joint is saturated from this fraction of its torque limit on


def _make_quantity_meta(unit: str, description: str) -> Meta:
    return Meta(description=description, extra_json_schema={"unit": unit})


class ProcessRestart(msgspec.Struct, frozen=True, kw_only=True):
    """A process that ended and was restarted."""

    name: str
    how: str
    at_s: float  # wall-clock time since the run's first process was started
    after_s: float  # delay before the restart


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The summary of a run. Unknown is null, never zero."""

    scenario: str
    robot: str
    scene: str
    backend: str
    emulated: Annotated[
        bool | None, Meta(description="whether nothing real moved; null: unknown")
    ] = None
    controller: str
    seed: int
    clock_mode: ClockMode
    rate_hz: Annotated[float, _make_quantity_meta("Hz", "control rate")]
    duration_s: Annotated[
        float, _make_quantity_meta("s", "robot time from the first arming to the end")
    ]
    wall_s: Annotated[float, _make_quantity_meta("s", "wall-clock time of the same")]
    real_time_factor: Annotated[float | None, _make_quantity_meta("1", "duration over wall time")]
    ticks: int
    overruns: Annotated[int, Meta(description="ticks that missed their deadline (realtime)")]
    answered_fraction: Annotated[
        float | None, _make_quantity_meta("1", "ticks whose command came within the tick")
    ]
    command_digest: Annotated[str, Meta(description="SHA-256 of every setpoint as applied")]
    path_distance_m: Annotated[
        float | None, _make_quantity_meta("m", "advance of the body along the scene's route")
    ]
    net_displacement_m: Annotated[
        float | None, _make_quantity_meta("m", "distance of the center of mass from its start")
    ]
    mean_speed_m_s: Annotated[
        float | None,
        _make_quantity_meta(
            "m/s", "path distance (or displacement) over the time in which it is known"
        ),
    ]
    pose_from: Annotated[
        str | None,
        Meta(
            description="what guidance had the pose from: sensor or dead_reckoning; null: unknown"
        ),
    ] = None
    contacts_from: Annotated[
        str | None,
        Meta(
            description="what guidance had contacts from: sensor or joint_torques; null: none, or unknown"
        ),
    ] = None
    dead_reckoned_distance_m: Annotated[
        float | None, _make_quantity_meta("m", "advance by dead reckoning; null: it was measured")
    ] = None
    dead_reckoning_error_m: Annotated[
        float | None,
        _make_quantity_meta(
            "m", "largest error of the pose by dead reckoning; null: one of the poses is unknown"
        ),
    ] = None
    locomoting_fraction: Annotated[
        float | None,
        _make_quantity_meta(
            "1",
            "fraction of the time in which the center of mass moved 2 cm or more within a second, as measured",
        ),
    ]
    propulsion_joints: Annotated[
        list[str] | None,
        Meta(description="one at a time, in order of use; null: control reported nothing"),
    ]
    hand_overs: Annotated[
        int | None,
        Meta(description="how often propulsion passed from one joint to another; null: as above"),
    ] = None
    jammed: Annotated[bool, Meta(description="whether the controller reported a jam at any time")]
    last_state: Annotated[
        str | None,
        Meta(description="at the end, by the measured motion; null: the pose is unknown"),
    ]
    last_reason: Annotated[
        str | None,
        Meta(description="why, as control reported it if its state agrees with the motion"),
    ]
    reported_state: Annotated[
        str | None, Meta(description="the last one that control reported")
    ] = None
    reported_reason: Annotated[
        str | None, Meta(description="the reason that control reported with it")
    ] = None
    peak_joint_torque_nm: Annotated[
        float | None, _make_quantity_meta("N·m", "largest torque of any joint")
    ]
    torque_saturated_fraction: Annotated[
        float | None, _make_quantity_meta("1", "ticks with a joint at its torque limit")
    ]
    peak_contact_force_n: Annotated[
        float | None,
        _make_quantity_meta(
            "N",
            "largest force of one contact, mean over 50 ms; or at one time, if the sensor does not average",
        ),
    ]
    desired_force_correlation: Annotated[
        float | None,
        _make_quantity_meta(
            "1",
            "of measured with desired forces at push-points while it locomoted; null: nothing to compare",
        ),
    ]
    desired_force_error: Annotated[
        float | None, _make_quantity_meta("1", "|measured - desired| over desired there, median")
    ]
    empty_push_points: Annotated[
        float | None, _make_quantity_meta("1", "fraction of those push-points without contact")
    ]
    energy_j: Annotated[
        float | None,
        _make_quantity_meta(
            "J",
            "sum over joints of |torque x velocity| over time, from one sample a control period",
        ),
    ]
    torque_joints_j: Annotated[
        float | None,
        _make_quantity_meta(
            "J",
            "sum of torque x velocity over time of joints in torque mode, from one sample a control period",
        ),
    ] = None
    position_joints_j: Annotated[
        float | None,
        _make_quantity_meta(
            "J",
            "the same of joints in position mode: less than the work of their motors, and maybe negative, because the "
            "samples miss the torque that each new target causes",
        ),
    ] = None
    goal_m: Annotated[
        float | None,
        _make_quantity_meta("m", "distance from the start to the mission's goal; null without one"),
    ] = None
    reached_goal: Annotated[
        bool | None, Meta(description="whether the goal was reached; null without one")
    ] = None
    goal_reached_s: Annotated[
        float | None, _make_quantity_meta("s", "from the first arming until the goal was reached")
    ] = None
    advance_m: Annotated[
        float | None,
        _make_quantity_meta(
            "m", "largest advance towards the goal; without one, along the body's first heading"
        ),
    ] = None
    advance_m_s: Annotated[
        float | None,
        _make_quantity_meta("m/s", "that, over the time until the goal was reached or the end"),
    ] = None
    energy_j_per_m: Annotated[
        float | None, _make_quantity_meta("J/m", "energy until then over the advance")
    ] = None
    stalled_s: Annotated[
        float | None,
        _make_quantity_meta(
            "s",
            "time until then in which the center of mass moved less than 2 cm within the last second, so that it "
            "counts from a second after the body came to rest",
        ),
    ] = None
    heading_advance_m: Annotated[
        float | None, _make_quantity_meta("m", "largest advance along the body's first heading")
    ] = None
    heading_energy_j_per_m: Annotated[
        float | None, _make_quantity_meta("J/m", "energy of the run over that")
    ] = None
    heading_body_lengths_s: Annotated[
        float | None,
        _make_quantity_meta("1/s", "that advance in lengths of the body over the time of the run"),
    ] = None
    heading_cost_of_transport: Annotated[
        float | None, _make_quantity_meta("1", "energy of the run over weight times that advance")
    ] = None
    displacement_m_s: Annotated[
        float | None,
        _make_quantity_meta(
            "m/s", "`net_displacement_m` over the time of the run, whatever the body's heading"
        ),
    ] = None
    displacement_bearing_rad: Annotated[
        float | None,
        _make_quantity_meta(
            "rad", "net displacement's direction from the body's first heading; left is positive"
        ),
    ] = None
    displacement_energy_j_per_m: Annotated[
        float | None, _make_quantity_meta("J/m", "energy of the run over `net_displacement_m`")
    ] = None
    displacement_body_lengths_s: Annotated[
        float | None, _make_quantity_meta("1/s", "`displacement_m_s` in lengths of the body")
    ] = None
    displacement_cost_of_transport: Annotated[
        float | None,
        _make_quantity_meta("1", "energy of the run over weight times `net_displacement_m`"),
    ] = None
    displacement_efficiency: Annotated[
        float | None,
        _make_quantity_meta(
            "1",
            "sliding friction of the weight over `net_displacement_m`, over the energy; level ground",
        ),
    ] = None
    displacement_slip: Annotated[
        float | None,
        _make_quantity_meta(
            "1", "1 less `net_displacement_m` over the mean path length of the links"
        ),
    ] = None
    lateral_slip: Annotated[
        float | None,
        _make_quantity_meta("1", "fraction of the links' paths that is across their own axes"),
    ] = None
    body_lengths_s: Annotated[
        float | None, _make_quantity_meta("1/s", "`advance_m_s` in lengths of the body")
    ] = None
    cost_of_transport: Annotated[
        float | None, _make_quantity_meta("1", "energy until then over weight times advance")
    ] = None
    propulsive_efficiency: Annotated[
        float | None,
        _make_quantity_meta(
            "1", "sliding friction of the weight over the advance, over that energy; level ground"
        ),
    ] = None
    jam_ratio: Annotated[
        float | None, _make_quantity_meta("1", "`stalled_s` over the time until then")
    ] = None
    impulse_n_s_per_m: Annotated[
        float | None, _make_quantity_meta("N·s/m", "of all contacts until then over the advance")
    ] = None
    torque_headroom: Annotated[
        float | None,
        _make_quantity_meta(
            "1", "fraction of its limit that every joint had left in 95 % of the ticks until then"
        ),
    ] = None
    form_closure: Annotated[
        float | None,
        _make_quantity_meta(
            "1",
            "fraction of the time until then in which obstacles within 2 cm would hold a stiff body",
        ),
    ] = None
    planning_fraction: Annotated[
        float | None,
        _make_quantity_meta(
            "1",
            "fraction of the planning cycles until then in which navigation searched for a path",
        ),
    ] = None
    state_to_command_us: Annotated[
        dict[str, float | None], _make_quantity_meta("µs", "state published to command received")
    ]
    tick_times: Annotated[
        dict[str, TimingStatistics],
        Meta(
            description="while armed: cycle, late (begin after the deadline), read and write (calls of the backend)"
        ),
    ] = {}
    too_slow: Annotated[
        list[str],
        Meta(description="services that could not keep up in real time, and what shows it"),
    ] = []
    rejected_commands: Annotated[dict[str, int], Meta(description="by reason")]
    limited_commands: Annotated[
        dict[str, int], Meta(description="joint setpoints changed by the limiter, by limit")
    ]
    faults: list[Fault]
    faults_left_out: Annotated[
        int, Meta(description="of `faults`, between the first and the newest")
    ] = 0
    isolated: Annotated[list[str], Meta(description="joints that were isolated at the end")] = []
    hosts: Annotated[
        int,
        Meta(description="how many HAL hosts the run had; all numbers here are of the last one"),
    ] = 1
    restarts: Annotated[
        list[ProcessRestart], Meta(description="processes that ended and were restarted")
    ] = []
    ended: Annotated[str, Meta(description="complete, interrupted, or what failed")]
    missing: Annotated[
        list[str], Meta(description="gaps of the record; numbers are computed from the rest")
    ] = []
    own_arithmetic: Annotated[
        list[str],
        Meta(
            description="what rounds otherwise than on most computers with NumPy 2.2 to 2.4: then the digest differs"
        ),
    ] = []
    config: Annotated[
        dict[str, Any], Meta(description="the effective configuration; repeats the run")
    ]


def get_distance_m(summary: RunSummary) -> float | None:
    """Return the distance along the path, or without a path the net displacement."""
    if summary.path_distance_m is not None:
        return summary.path_distance_m
    return summary.net_displacement_m


def get_estimates(summary: RunSummary) -> EstimateMetrics:
    """Return the estimates of guidance that the summary of a run contains."""
    return EstimateMetrics(
        summary.pose_from,
        summary.contacts_from,
        summary.dead_reckoned_distance_m,
        summary.dead_reckoning_error_m,
    )


def summarize_run(
    record: RunRecord, ended: str, restarts: Sequence[ProcessRestart] = (), hosts: int = 1
) -> RunSummary:
    """Compute all metrics of a run from its record.

    Args:
        record: The recorded run.
        ended: How the run ended: complete, interrupted, or a sentence about what failed.
        restarts: The processes that ended and were restarted.
        hosts: Number of HAL hosts that the run had, one after another.
    """
    config = record.config
    host = record.host
    duration_s = host.ticks * config.period_ns * 1e-9
    path_distance_m, net_displacement_m, pose_known_duration_s = _measure_distances(record)
    distance_m = path_distance_m if path_distance_m is not None else net_displacement_m
    stop_intervals = find_stops(record)
    has_torque_and_velocity = bool(np.isfinite(record.torque_nm * record.velocity_rad_s).any())
    progress = ForwardProgress.from_run(record)
    last_report = record.control_states[-1] if record.control_states else None
    too_slow: list[str] = []
    if last_report and last_report.too_slow:
        too_slow.append(f"control: {last_report.too_slow}")
    return RunSummary(
        # What was run.
        scenario=config.name,
        robot=config.robot.name,
        scene=config.scene.name,
        backend=config.backend,
        emulated=record.description.emulated,
        controller=config.commander_name,
        seed=config.seed,
        clock_mode=config.clock_mode,
        rate_hz=config.rate_hz,
        # Time.
        duration_s=duration_s,
        wall_s=host.wall_s,
        real_time_factor=duration_s / host.wall_s if host.wall_s > 0 else None,
        ticks=host.ticks,
        overruns=host.overruns,
        answered_fraction=host.answered_ticks / host.armed_ticks if host.armed_ticks else None,
        command_digest=host.command_digest,
        # Motion.
        path_distance_m=path_distance_m,
        net_displacement_m=net_displacement_m,
        **vars(EstimateMetrics.from_run(record)),
        mean_speed_m_s=distance_m / pose_known_duration_s if distance_m is not None else None,
        locomoting_fraction=stop_intervals.moving_fraction if stop_intervals else None,
        **_summarize_control_reports(record, stop_intervals, last_report),
        # Forces and effort.
        **_compute_force_and_energy_metrics(
            record, has_torque_and_velocity=has_torque_and_velocity
        ),
        **_compute_advance_metrics(
            record, progress, has_torque_and_velocity=has_torque_and_velocity
        ),
        **vars(
            EffortMetrics.from_run(
                record, progress, has_torque_and_velocity=has_torque_and_velocity
            )
        ),
        **vars(
            HeadingEffort.from_run(
                record,
                progress,
                pose_known_duration_s,
                has_torque_and_velocity=has_torque_and_velocity,
            )
        ),
        **vars(
            DisplacementMetrics.from_run(
                record,
                progress,
                pose_known_duration_s,
                has_torque_and_velocity=has_torque_and_velocity,
            )
        ),
        # The host and its processes.
        state_to_command_us=host.state_to_command_us,
        tick_times=host.tick_times,
        too_slow=too_slow,
        rejected_commands=host.rejected_commands,
        limited_commands=host.limited_commands,
        faults=host.faults,
        faults_left_out=host.faults_left_out,
        isolated=host.isolated,
        hosts=hosts,
        restarts=list(restarts),
        ended=ended,
        missing=record.missing,
        own_arithmetic=find_differing_parts(record.description.arithmetic),
        config=msgspec.to_builtins(config),
    )


def _summarize_control_reports(
    record: RunRecord, stop_intervals: StopIntervals | None, last_report: ControlState | None
) -> dict[str, Any]:
    """Summarize the states that the controller reported during a run.

    Args:
        record: The recorded run.
        stop_intervals: Measured intervals without motion; None if the pose is unknown.
        last_report: Last message of the controller; None if it published none.

    Returns:
        Values by name of the field in RunSummary. A value is None if it is unknown.
    """
    propulsion_joints = None
    hand_overs = None
    if record.control_states:
        periods = find_propulsion_periods(record)
        propulsion_joints = [
            record.description.joints[period.joint_index].name for period in periods
        ]
        hand_overs = count_hand_overs(periods)
    last_state, last_reason = find_last_state(stop_intervals, last_report)
    return {
        "propulsion_joints": propulsion_joints,
        "hand_overs": hand_overs,
        "jammed": any(state.jammed for state in record.control_states),
        "last_state": last_state,
        "last_reason": last_reason,
        "reported_state": last_report.state if last_report else None,
        "reported_reason": last_report.reason if last_report else None,
    }


def _compute_force_and_energy_metrics(
    record: RunRecord, *, has_torque_and_velocity: bool
) -> dict[str, Any]:
    """Compute the metrics of torques, contact forces and energy of a run.

    Args:
        record: The recorded run.
        has_torque_and_velocity: Whether joint torques and velocities are known, so that energy can be computed.

    Returns:
        Values by name of the field in RunSummary. A value is None if it is unknown.
    """
    has_ticks = len(record.time_s) > 0
    saturated_fraction = None
    if has_ticks:
        limits_nm = np.array([joint.torque_limit_nm for joint in record.description.joints])
        is_saturated = np.abs(record.torque_nm) >= SATURATION_RATIO * limits_nm  # (n, joints)
        saturated_fraction = float(is_saturated.any(axis=1).mean())
    peak_contact_force_n = None
    if record.has_contact_sensors and has_ticks:
        peak_contact_force_n = max_or_none(record.contact_peak_n)

    metrics: dict[str, Any] = {
        "peak_joint_torque_nm": max_or_none(np.abs(record.torque_nm)),
        "torque_saturated_fraction": saturated_fraction,
        "peak_contact_force_n": peak_contact_force_n,
        "desired_force_correlation": None,
        "desired_force_error": None,
        "empty_push_points": None,
        "energy_j": None,
        "torque_joints_j": None,
        "position_joints_j": None,
    }
    # None if no desired force can be compared.
    tracking = measure_force_tracking(record.control_states)
    if tracking:
        metrics["desired_force_correlation"] = tracking.correlation
        metrics["desired_force_error"] = tracking.median_error
        metrics["empty_push_points"] = tracking.no_contact_fraction
    if has_torque_and_velocity:
        metrics["energy_j"] = compute_energy_j(record)
        metrics["torque_joints_j"] = compute_work_j(record, JointMode.TORQUE)
        metrics["position_joints_j"] = compute_work_j(record, JointMode.POSITION)
    return metrics


def _compute_advance_metrics(
    record: RunRecord, progress: ForwardProgress | None, *, has_torque_and_velocity: bool
) -> dict[str, Any]:
    """Compute the metrics of the advance of a run.

    Args:
        record: The recorded run.
        progress: Advance of the body; None if the pose is unknown.
        has_torque_and_velocity: Whether joint torques and velocities are known, so that energy can be computed.

    Returns:
        Values by name of the field in RunSummary. All are None if the pose is unknown.
    """
    if progress is None:
        return dict.fromkeys(
            ("goal_m", "reached_goal", "goal_reached_s", "advance_m", "advance_m_s")
        )
    return {
        "goal_m": progress.goal_distance_m,
        "reached_goal": progress.goal_reached_s is not None
        if progress.goal_distance_m is not None
        else None,
        "goal_reached_s": progress.goal_reached_s,
        "advance_m": progress.final_advance_m,
        "advance_m_s": progress.final_advance_m / progress.goal_or_end_s
        if progress.goal_or_end_s > 0
        else None,
        "energy_j_per_m": compute_energy_j_per_m(record, progress)
        if has_torque_and_velocity
        else None,
        "stalled_s": progress.stationary_duration_s,
    }


def find_last_state(
    stop_intervals: StopIntervals | None, last_report: ControlState | None
) -> tuple[str | None, str | None]:
    """Return the locomotion state at the end of a run, and its reason, by the measured motion.

    The reason that control reported is used if its state agrees with the measured motion.

    Args:
        stop_intervals: Measured intervals without motion; None if the pose is unknown.
        last_report: Last message of the controller; None if it published none.

    Returns:
        The state and the reason. Both are None if the pose is unknown.
    """
    if stop_intervals is None:
        return None, None
    reports_motion = last_report is not None and last_report.state == "Locomoting"
    if stop_intervals.final_stop is None:
        reason = last_report.reason if last_report is not None and reports_motion else "moving"
        return "Locomoting", reason
    if last_report is not None and not reports_motion:
        return last_report.state, last_report.reason
    return "NotLocomoting", STANDING_STILL


def measure_route_position_m(record: RunRecord, row: int) -> float | None:
    """Return the position of the body along the route: the mean arc length of tail end, joints and head end.

    Args:
        record: The recorded run.
        row: Index of the tick in the record.

    Returns:
        The position in m, or None if the scene has no route or the pose is unknown.
    """
    body_points_w = record.find_body_points_w(row)
    if body_points_w is None or record.route is None:
        return None
    return float(np.mean([record.route.project_point(point_w[:2]) for point_w in body_points_w]))


def max_or_none(values: np.ndarray) -> float | None:
    """Return the maximum of all finite values, or None if there is none."""
    known = values[np.isfinite(values)]
    return float(known.max()) if len(known) else None


def _measure_distances(record: RunRecord) -> tuple[float | None, float | None, float]:
    """Measure how far the body moved from its first known pose to its last.

    Returns:
        path_distance_m: Advance along the route, mean over the body, in m; None without a route or without poses.
        net_displacement_m: Net displacement of the center of mass, in m; None without poses.
        pose_known_duration_s: Time from the first known pose to the last, in s; 0 without poses.
    """
    rows_with_pose = np.flatnonzero(record.has_pose)
    if len(rows_with_pose) < 2:
        return None, None, 0.0
    first_row = int(rows_with_pose[0])
    last_row = int(rows_with_pose[-1])
    first_points_w = record.find_body_points_w(first_row)
    last_points_w = record.find_body_points_w(last_row)
    if first_points_w is None or last_points_w is None:
        return None, None, 0.0

    robot = record.description
    displacement_w = compute_center_of_mass_w(robot, last_points_w) - compute_center_of_mass_w(
        robot, first_points_w
    )
    net_displacement_m = float(np.linalg.norm(displacement_w))

    path_distance_m = None
    start_m = measure_route_position_m(record, first_row)
    end_m = measure_route_position_m(record, last_row)
    if start_m is not None and end_m is not None:
        path_distance_m = end_m - start_m

    # Ticks that are missing in a gap count as well, because the body moved during the gap.
    tick_count = int(record.ticks[last_row] - record.ticks[first_row]) + 1
    pose_known_duration_s = tick_count * record.config.period_ns * 1e-9
    return path_distance_m, net_displacement_m, pose_known_duration_s
