"""A thread that renders: it makes the samples of cameras and lidars from copies of the state, beside the ticks."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import Message

ResultT = TypeVar("ResultT")


class SnapshotThread:
    """One thread, and the state that it works on."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Start the thread now: one that a host starts later would have the host's real-time priority."""
        self.data = mujoco.MjData(model)
        self._model = model
        self._thread = ThreadPoolExecutor(1, "sensors")
        self.run(lambda: None)

    def run(self, work: Callable[[], ResultT]) -> ResultT:
        """Run a function in the thread, and wait for its result. All that uses OpenGL must run in one thread."""
        return self._thread.submit(work).result()

    def start_sample(
        self,
        read: Callable[[int, int], Message],
        tick: int,
        timestamp_ns: int,
        qpos: NDArray[np.float64],
    ) -> Future[Message]:
        """Begin a sample of the state `qpos`, which is copied. Samples are made in the order of these calls."""
        return self._thread.submit(self._read, read, tick, timestamp_ns, qpos.copy())

    def close(self) -> None:
        """Cancel what has not begun, and end the thread."""
        self._thread.shutdown(wait=True, cancel_futures=True)

    def _read(
        self,
        read: Callable[[int, int], Message],
        tick: int,
        timestamp_ns: int,
        qpos: NDArray[np.float64],
    ) -> Message:
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self.data)
        return read(tick, timestamp_ns)
