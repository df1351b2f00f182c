"""Rows about streams that stop, a wall clock that steps, and a simulator that is slow or diverges."""

from snakesim_hal.wire import keys
from verification.faults.row import FaultHeading, FaultRow
from verification.faults.rows import simulator, streams, wall_clock
from verification.faults.table.row_kinds import (
    LEASE_MS,
    PERIOD_MS,
    apply_to_sim_and_can,
    make_stream_row,
)

STREAM_STOPS = FaultHeading(
    fault="a stream that control needs stops: from a sensor, from guidance or from navigation",
    expected="without joint states, the robot stops. Without another stream, the controller holds, and continues when "
    "the stream is back",
    deadline="joints: 30 ms and the lease; others: their `max_age`",
    rows=(
        FaultRow(
            name="stream_joints",
            fault="sensor/joints: all of it is lost",
            expected="no command on a state that is too old: safe stop by the lease, lease freed, fault latched",
            deadline="30 ms that a state may be old, the lease (50 ms), and a tick (10 ms) of injector, control and "
            "host",
            limit=30.0 + LEASE_MS + 3 * PERIOD_MS,
            unit="ms",
            measures=apply_to_sim_and_can(streams.measure_lost_joint_states),
        ),
        make_stream_row("stream_pose", keys.POSE, max_age_ms=240.0),
        make_stream_row("stream_contacts", keys.CONTACTS, max_age_ms=240.0),
        make_stream_row("stream_world", keys.WORLD, max_age_ms=220.0),
        make_stream_row("stream_trajectory", keys.TRAJECTORY, max_age_ms=840.0),
    ),
)

WALL_CLOCK_STEPS = FaultHeading(
    fault="the wall clock steps by an hour in either direction",
    expected="no effect on the robot",
    deadline="-",
    rows=(
        FaultRow(
            name="clock_step",
            fault="the wall clock goes an hour ahead, and back",
            expected="nothing: no fault, no lease missed",
            deadline="-",
            limit=0.0,
            unit="faults and stops",
            measures=apply_to_sim_and_can(wall_clock.measure_clock_step),
            environment="guest",
        ),
    ),
)

SLOW_SIMULATOR = FaultHeading(
    fault="the simulator is slower than real time in lockstep (0.1x)",
    expected="the robot does not stop",
    deadline="-",
    rows=(
        FaultRow(
            name="slow_simulator",
            fault="the simulator runs at a tenth of real time, in lockstep",
            expected="no stop, no fault: leases count in simulated time",
            deadline="-",
            limit=0.0,
            unit="stops and faults",
            measures=apply_to_sim_and_can(simulator.measure_slow_simulator),
        ),
    ),
)

SIMULATION_DIVERGES = FaultHeading(
    fault="the simulation diverges",
    expected="the robot stops with a fault, and the last good state stays",
    deadline="one step",
    rows=(
        FaultRow(
            name="simulation_diverges",
            fault="the simulator's state becomes impossible",
            expected="stop and fault in the same step; nothing that is no number is published or recorded",
            deadline="one step",
            limit=1.0,
            unit="steps",
            measures={
                "sim": simulator.measure_divergence,
                "can": "modules on a bus are no simulation that could diverge",
            },
        ),
    ),
)
