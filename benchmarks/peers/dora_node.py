"""Both nodes of a dora-rs dataflow: `robot` sends the state and waits for the command, `controller` answers."""

import sys

import pyarrow as pa
from dora import Node

sys.path.insert(0, __file__.rpartition("/")[0])
from loop import measure_round_trips_us, read_loop_parameters, write_times

state_bytes, command_bytes, rounds, period_s = read_loop_parameters()
node = Node()


def receive_event() -> bool:
    """Wait for one input. Return False if the dataflow ends instead."""
    while True:
        event = node.next()
        if event is None or event["type"] == "STOP":
            return False
        if event["type"] == "INPUT":
            event["value"].to_numpy()
            return True


if sys.argv[1] == "controller":
    command = pa.array(bytearray(command_bytes), type=pa.uint8())
    while receive_event():
        node.send_output("command", command)
else:
    state = bytearray(state_bytes)

    def exchange() -> None:
        node.send_output("state", pa.array(state, type=pa.uint8()))
        receive_event()

    write_times(measure_round_trips_us(exchange, rounds, period_s))
