"""Runs a service in a thread of the host's process, over the host's own connection to the network.

The service uses the same client, messages, lease and limiter as in a process of its own, and publishes the same.
A command then reaches the host without another process, a socket or another scheduler in between.

What it costs: service and host share one interpreter. A service that raises, hangs or computes without end in Python
loses its lease, as anywhere. One that holds the interpreter (compiled code without end) stops the host too, and with it
the stop port: modules then stop by their own watchdogs. One that ends its process ends the host.
"""

import threading
import time
import traceback
from contextlib import closing
from typing import Self

from threadpoolctl import threadpool_limits

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.process import SERVICE_PRIORITY, set_realtime_priority
from snakesim_hal.base.terminal import report_error
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.session import Session
from snakesim_hal.programs.preflight import load_service_class
from snakesim_hal.service import ServiceLoop

RESTART_PAUSE_S = 1.0  # until a service that ended is started again
CLOSE_TIMEOUT_S = 0.5  # for all threads to end; one that hangs ends with the process


class InHostServices:
    """The services of a run that run inside the host, from `with` to its end. They wait for the host to publish."""

    def __init__(self, config: RunConfig, session: Session) -> None:
        self._config = config
        self._session = session
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._run_service, args=(name,), name=name, daemon=True)
            for name in config.in_host_services
        ]

    def __enter__(self) -> Self:
        if self._threads:
            # As in a process of its own: sums of several threads are rounded otherwise.
            threadpool_limits(1)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._closing.set()
        deadline = time.monotonic() + CLOSE_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0.0))

    def _run_service(self, name: str) -> None:
        """Run a service, and restart it after it has ended if the configuration allows it, until the host ends."""
        if self._config.clock_mode == "realtime":
            set_realtime_priority(SERVICE_PRIORITY)
        while not self._closing.is_set():
            self._run_service_once(name)
            if not self._config.services[name].restart or self._closing.wait(RESTART_PAUSE_S):
                return

    def _run_service_once(self, name: str) -> None:
        """Run a service until it fails, or the host ends. The host sees the end, because its liveliness token ends."""
        try:
            with closing(self._session.create_subsession()) as part:
                service_type = load_service_class(self._config, name)
                with closing(
                    ServiceLoop(service_type, self._config, part, self._is_host_running)
                ) as loop:
                    loop.connect()
                    loop.run(self._closing.is_set)
        except SnakesimError as error:
            if not self._closing.is_set():
                report_error(error, f"snakesim {name}")
        except Exception:  # noqa: BLE001 - this thread's outermost loop: the host continues, and stops the robot
            if not self._closing.is_set():
                traceback.print_exc()

    def _is_host_running(self) -> bool:
        return not self._closing.is_set()
