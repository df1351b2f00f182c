"""The source of a controller and a backend that misbehave in tick 30, in a way that a test inserts."""

BAD = """
import ctypes
import os
import signal
import sys
import time

from snakesim_gnc.control.hold import HoldPose
from snakesim_sim_backend.backend import SimBackend

DEEDS = {
    "raises": lambda: 1 / 0,
    "exits": lambda: sys.exit(0),
    "dies": lambda: os._exit(0),
    "hangs": lambda: time.sleep(1e6),
    "spins": lambda: [None for _ in iter(int, 1)],
    "holds the interpreter": lambda: ctypes.PyDLL(None).sleep(1000),
    "spams": lambda: [print("x" * 100_000) for _ in iter(int, 1)],
    "stops": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "closes": lambda: os.closerange(3, 4096),
    "interrupts": lambda: os.kill(os.getpid(), signal.SIGINT),
}


class Controller(HoldPose):
    calls = 0

    def update(self, observation):
        Controller.calls += 1
        if Controller.calls == 30:
            DEEDS["%s"]()
        return super().update(observation)


class Backend(SimBackend):
    def sample(self, tick, timestamp_ns):
        if tick == 30:
            DEEDS["%s"]()
        return super().sample(tick, timestamp_ns)
"""
