"""Lease a robot, arm it, turn one joint by 0.1 rad, disarm it: with zenoh and msgpack alone. Explained in client.md."""

import json
import sys
import time

import msgpack
import zenoh

ENDPOINT, ROBOT = sys.argv[1:] or ("tcp/127.0.0.1:7447", "planar13")
JOINT, TURN_RAD = "joint_3", 0.1
QUIET = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
LINK = {
    "mode": "client",
    "connect": {"endpoints": [ENDPOINT]},
    "namespace": ROBOT,
    "scouting": QUIET,
}
FORM = "application/msgpack;snakesim.{}/1"
SILENCE_S = 15  # longer than the 10 s for which lockstep waits for another service
BLOCK = zenoh.CongestionControl.BLOCK  # lose no command, so that lockstep goes on


def newest(arrivals, meanwhile=lambda: time.sleep(0.0005), known=None):
    """The newest arrival; if there is none, `known`, or what arrives within SILENCE_S."""
    give_up = time.monotonic() + SILENCE_S
    while (arrival := arrivals.try_recv()) is None:
        if known is not None:
            return known
        meanwhile() if time.monotonic() < give_up else sys.exit("the robot is silent")
    return msgpack.unpackb(getattr(arrival, "ok", arrival).payload.to_bytes())


def ask(key, message, *meanwhile, **request):
    answer = newest(
        session.get(key, payload=msgpack.packb(request), encoding=FORM.format(message)), *meanwhile
    )
    return answer if answer["ok"] else sys.exit(f"{key}: {answer['reason']}")


def command(turn_rad=0.0):
    """At the next clock, the last sample of a tick, answer the newest joint state."""
    clock = newest(clocks)
    state.update(newest(joints, known=state))
    answers = {
        "tick": state["tick"],
        "arm_session": clock["arm_session"],
        "sequence": time.monotonic_ns(),
    }
    target = [*start[:number], start[number] + turn_rad, *start[number + 1 :]]
    # Mode 1: rad.
    payload = msgpack.packb({**rights, **answers, "mode": [1] * len(target), "target": target})
    session.put(
        "actuator/joints", payload, encoding=FORM.format("JointCommand"), congestion_control=BLOCK
    )


with zenoh.open(zenoh.Config.from_json5(json.dumps(LINK))) as session:
    robot = newest(session.get("hal/description/@adv/**", accept_replies=zenoh.ReplyKeyExpr.ANY))
    number = [joint["name"] for joint in robot["joints"]].index(JOINT)
    joints = session.declare_subscriber("sensor/joints", zenoh.handlers.RingChannel(1))
    clocks = session.declare_subscriber("hal/clock", zenoh.handlers.RingChannel(1))
    # Last: from the next tick on, a run waits for it.
    present = session.liveliness().declare_token("alive/control")
    start = (state := newest(joints))["angle_rad"]
    lease = ask("hal/lease", "LeaseRequest", action="acquire", holder="control")
    rights = {
        "lease_epoch": lease["epoch"],
        "layout": robot["layout"],
        "valid_for_ns": robot["lease_ns"],
    }
    for _ in range(5):  # commands flow before the robot is armed
        command()
    meant = {key: robot[key] for key in ("robot", "backend", "config_hash", "host")}
    ask("hal/lifecycle", "LifecycleRequest", command, action="arm", requester="client.py", **meant)
    for tick in range(2 * round(1e9 / robot["period_ns"])):  # a second to turn, and one to arrive
        command(min(tick * robot["period_ns"] * 1e-9, 1.0) * TURN_RAD)
    ask(
        "hal/lifecycle",
        "LifecycleRequest",
        lambda: command(TURN_RAD),
        action="disarm",
        requester="client.py",
        **meant,
    )
    print(
        f"{JOINT} turned by {state['angle_rad'][number] - start[number]:+.3f} rad; the robot is disarmed"
    )
