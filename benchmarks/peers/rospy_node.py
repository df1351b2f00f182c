"""Both nodes of ROS 1: `robot` publishes a JointState and waits for the command, `controller` answers with another."""

import sys
import threading

import rospy
from sensor_msgs.msg import JointState

sys.path.insert(0, __file__.rpartition("/")[0])
from loop import measure_round_trips_us, read_loop_parameters, write_times

JOINTS = 13
_, _, rounds, period_s = read_loop_parameters()
role = sys.argv[1]
rospy.init_node(role, disable_signals=True)


def message():
    return JointState(
        name=[f"joint_{i}" for i in range(JOINTS)],
        position=[0.1] * JOINTS,
        velocity=[0.1] * JOINTS,
        effort=[0.1] * JOINTS,
    )


if role == "controller":
    command = rospy.Publisher("command", JointState, queue_size=1, tcp_nodelay=True)
    rospy.Subscriber(
        "state", JointState, lambda _state: command.publish(message()), tcp_nodelay=True
    )
    rospy.spin()
else:
    came = threading.Event()
    state = rospy.Publisher("state", JointState, queue_size=1, tcp_nodelay=True)
    rospy.Subscriber("command", JointState, lambda _command: came.set(), tcp_nodelay=True)

    def exchange():
        came.clear()
        state.publish(message())
        if not came.wait(5.0):
            raise TimeoutError("no command within 5 s")

    while not (state.get_num_connections() and not came.is_set()):
        rospy.sleep(0.05)
    rospy.sleep(1.0)
    write_times(measure_round_trips_us(exchange, rounds, period_s))
