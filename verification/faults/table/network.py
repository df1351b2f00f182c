"""Rows about the network: a cut, slow consumers, and emergency stops under an attack."""

from verification.faults.row import FaultHeading
from verification.faults.rows import attacks, consumers, network
from verification.faults.table.row_kinds import (
    STOP_MS,
    make_consumer_row,
    make_flood_row,
    make_lease_row,
    make_stop_row,
)

NETWORK_CUT = FaultHeading(
    fault="the network between controller and robot is cut (namespaces with a veth pair, link down)",
    expected="the host stops the robot",
    deadline="lease",
    rows=(
        make_lease_row(
            "network_cut",
            "link down between host and services",
            network.measure_cut_network,
            environment="namespaces",
        ),
    ),
)

SLOW_CONSUMER = FaultHeading(
    fault="a subscriber is slow (sleeping callback, full disk, frozen process)",
    expected="only that subscriber is affected. No control cycle is missed",
    deadline="-",
    rows=(
        make_consumer_row(
            "consumer_sleeps",
            "a consumer's callback sleeps for 0.5 s at every sample",
            consumers.measure_sleeping_consumer,
        ),
        make_consumer_row(
            "consumer_disk_full",
            "a consumer writes to a disk that is full",
            consumers.measure_consumer_with_full_disk,
        ),
        make_consumer_row(
            "consumer_frozen",
            "four readers of everything are frozen (SIGSTOP)",
            consumers.measure_frozen_readers,
        ),
    ),
)

STOP_UNDER_ATTACK = FaultHeading(
    fault="an emergency stop while the network is flooded, occupied or blocked",
    expected="the robot stops at once, regardless of the traffic",
    deadline=f"{STOP_MS:.0f} ms",
    rows=(
        make_flood_row("stop_half_open", "300 half-open connections", "half_open"),
        make_flood_row("stop_idle", "1000 sessions that do nothing, or as many as get in", "idle"),
        make_flood_row("stop_lease_flood", "lease queries, as many as two processes can", "lease"),
        make_flood_row(
            "stop_sample_flood", "10,000 samples of noise a second on every key", "garbage"
        ),
        make_flood_row(
            "stop_datagram_flood",
            "wrong datagrams at the stop port, as many as a thread can",
            "datagrams",
        ),
        make_stop_row(
            "stop_readers_leave",
            "300 readers of everything leave at once",
            attacks.measure_stop_while_readers_leave,
        ),
    ),
)
