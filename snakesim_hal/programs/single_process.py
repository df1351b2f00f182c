"""A whole run in one process and one thread, without a network: host, guidance, navigation and control act in turn.

    with InProcessRun(config) as run:
        for _ in run.iterate_ticks():
            ...  # once a tick; run.host.authority, run.network.session() for readers, run.stop()
    record_of(run.host).command_digest

The parts are those of a run in lockstep: the same host with its authority, the same services, and the same bytes
between them. So a configuration gives the same motor commands in both, to the last bit. A configuration that needs
processes or a network is refused.
"""

import itertools
import time
import traceback
from collections.abc import Generator
from contextlib import ExitStack, closing
from typing import Self

from threadpoolctl import threadpool_limits

from snakesim_hal.base.errors import ConfigError, RefusedError, ServiceError, SnakesimError
from snakesim_hal.base.step_limit import SharedStepTimes, StepLimit, StepTooLongError, describe_interrupted_line
from snakesim_hal.base.terminal import report_error
from snakesim_hal.faults.allowed import create_host_faults
from snakesim_hal.host.host import Host, HostOptions
from snakesim_hal.model.fault_plan import parse_planned
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.programs.host_program import open_backend
from snakesim_hal.programs.preflight import find_backend, find_service
from snakesim_hal.service import SERVICE_START_LIMIT_S, ServiceLoop
from snakesim_hal.wire.messages import make_arm_request

AFTER_FAULT_S = 1.5
ARM_LIMIT_S = 10.0  # the run gives up when both limits have passed:
ARM_LIMIT_TURNS = 100  # planning, or a busy computer, may need long for one turn
TURN_LIMIT_S = 60.0  # of one part in one turn; a part that needs longer is assumed to compute without end
INTERRUPT_GRACE_S = 1.0  # of the present turn of a part, after Ctrl-C
ENDED = object()  # the host has no further turn
REQUESTER = "run in one process"  # of the arming


def check(config: RunConfig) -> None:
    """Check that a run needs neither several processes nor a network. Raises ConfigError if it does."""
    where = f"scenario {config.name!r} in one process"
    if config.clock_mode != "lockstep":
        raise ConfigError(
            f"{where}: clock mode is {config.clock_mode!r}, must be 'lockstep'; add --clock-mode lockstep",
            code="backend/wrong-clock-mode",
        )
    if not config.has_own_control:
        raise ConfigError(
            f"{where}: no controller commands the robot; it needs a control service that is not external",
            code="config/conflict",
        )
    for name, service in config.services.items():
        if service.external:
            raise ConfigError(
                f"{where}: services.{name} is external, and there is no network to meet it", code="config/conflict"
            )
    for injection in parse_planned(config):
        if injection.target_type in ("process", "clock"):
            raise ConfigError(
                f"{where}: fault {str(injection)!r} needs processes of their own", code="injection/not-supported"
            )


class InProcessRun:
    """One run in this process. Its `with` opens and closes the backend and all services."""

    def __init__(
        self, config: RunConfig, step_times: SharedStepTimes | None = None, turn_limit_s: float | None = None
    ) -> None:
        """Check the configuration.

        Args:
            config: of the run.
            step_times: shows another process that the run continues.
            turn_limit_s: wall time that a part may take in one turn; None: as the configuration allows.

        Raises:
            ConfigError: the run needs more than one process.
        """
        check(config)
        self.config = config
        self._limit = StepLimit(SERVICE_START_LIMIT_S, step_times)
        self._turn_limit_s = turn_limit_s or max(TURN_LIMIT_S, config.start_limit_s)
        self.network = LocalNetwork()
        self.failed: list[str] = []  # services that ended with an error, and the error
        self._errors: dict[str, SnakesimError] = {}  # by name of the service
        self._loops: dict[str, ServiceLoop] = {}
        self._parts: dict[str, ExitStack] = {}
        self._opened = ExitStack()

    def __enter__(self) -> Self:
        """Open the backend and all services. Raises SnakesimError."""
        with ExitStack() as opening:
            try:
                with self._limit:
                    self._open(opening)
            except StepTooLongError as error:
                raise RefusedError(
                    f"the run did not begin: {self._explain(error)}", code="backend/step-timeout"
                ) from error
            self._opened = opening.pop_all()
        self._limit.limit_s = self._turn_limit_s
        return self

    def __exit__(self, *_error: object) -> None:
        self._limit.close()
        self._opened.close()

    def _open(self, opened: ExitStack) -> None:
        """Open the backend, the host and all services, each to be closed by the stack.

        Raises:
            RefusedError: the backend moves real hardware.
        """
        # Services in their own processes use one thread, too. Several threads would round sums differently.
        opened.enter_context(threadpool_limits(1))
        self._open_host(opened)
        for name in self.config.services:
            self._open_service(name, opened)

    def _open_host(self, opened: ExitStack) -> None:
        """Open the emulated backend, and create the HAL host on the network of this process.

        Args:
            opened: gets what has to be closed at the end of the run.

        Raises:
            RefusedError: the backend moves real hardware.
        """
        config = self.config
        backend = open_backend(find_backend(config.backend), config)
        opened.callback(backend.close)
        if not backend.describe().emulated:
            raise RefusedError(
                f"backend {config.backend!r} moves real hardware, which could not be stopped from outside: run it in "
                "processes of their own",
                code="robot/real-hardware",
            )
        session = self.network.session()
        opened.callback(session.close)
        backend_with_faults, faults = create_host_faults(config, backend, session)
        options = HostOptions(
            max_ticks=round(config.duration_s * config.rate_hz),
            end_after_fault_s=AFTER_FAULT_S,
            clock_mode_after_fault="free",
            faults=faults,
        )
        self.host = Host(config, backend_with_faults, session, options)
        self.network.answer = self.host.handle_queued_input
        opened.callback(self.network.close)

    def _open_service(self, name: str, opened: ExitStack) -> None:
        part = opened.enter_context(ExitStack())
        session = self.network.session()
        part.callback(session.close)
        loop = ServiceLoop(find_service(self.config, name), self.config, session)
        part.callback(loop.close)
        self._parts[name] = part
        self._loops[name] = loop

    def iterate_ticks(self, *, before_services: bool = False) -> Generator[None]:
        """Let all parts act in turn, and arm the robot when it is ready. The joints are safe at the end.

        Args:
            before_services: yield when the samples of a tick are published and no service has acted on them, instead
                of after the turn of all services.

        Yields:
            Once for each turn, also for those before the arming. The generator may be closed early.

        Raises:
            RefusedError: the robot is not ready to arm in time.
            SnakesimError: the run cannot continue.
        """
        arm_limit_s = min(ARM_LIMIT_S, self.config.start_limit_s)
        arm_deadline_s = time.monotonic() + arm_limit_s
        with closing(self.host.iterate_ticks()) as host_turns:
            for turn in itertools.count():
                with self._limit:  # the backend may be third-party code, and turns this into an error of its own
                    if next(host_turns, ENDED) is ENDED:
                        return
                if turn == 0:
                    for loop in self._loops.values():
                        loop.join()
                if before_services:
                    yield
                self._let_services_act()
                if not self.host.authority.arm_session and not self.failed:
                    is_too_late = turn > ARM_LIMIT_TURNS and time.monotonic() > arm_deadline_s
                    self._arm_when_ready(is_too_late, arm_limit_s)
                if not before_services:
                    yield

    def _arm_when_ready(self, is_too_late: bool, limit_s: float) -> None:
        """Request the arming if the robot is ready. Raises RefusedError if it is too late for that."""
        status = self.host.status()
        if is_too_late:
            raise RefusedError(f"not ready to arm within {limit_s:g} s: {status.reason}", code="robot/not-ready")
        if status.ready_to_arm:
            self.host.submit_request(make_arm_request(self.host.description, REQUESTER), lambda _answer: None)

    def stop(self) -> None:
        """End the run in order."""
        self.host.stop()

    def take_errors(self) -> dict[str, SnakesimError]:
        """Return the error that ended each service, by name, and drop the errors here.

        The traceback of an error refers to this run. If the run also held the error, neither could be freed.
        """
        errors = self._errors
        self._errors = {}
        return errors

    def too_slow(self) -> list[str]:
        """Return the services that were too slow for real time, each with the measurement that shows it."""
        slow_services: list[str] = []
        for name, loop in self._loops.items():
            if loop.service.too_slow:
                slow_services.append(f"{name}: {loop.service.too_slow}")
        return slow_services

    def hurry(self) -> None:
        """Interrupt a part that does not return within INTERRUPT_GRACE_S. May be called by a signal handler."""
        self._limit.hurry(INTERRUPT_GRACE_S)

    def _let_services_act(self) -> None:
        """Give every service its turn. One that raises an error is closed, as its process would end."""
        for name, loop in list(self._loops.items()):
            try:
                self._act_in_time(loop)
            except SnakesimError as error:
                report_error(error, f"snakesim {name}")
                self._errors[name] = error
                self.failed.append(f"{name} ended: {error}")
                del self._loops[name]
                self._parts[name].close()

    def _act_in_time(self, loop: ServiceLoop) -> None:
        """Give a service its turn. Raises ServiceError if the turn takes too long."""
        try:
            with self._limit:
                loop.act()
        except StepTooLongError as error:
            traceback.print_exc()
            raise ServiceError(self._explain(error), code="backend/step-timeout") from None

    def _explain(self, error: StepTooLongError) -> str:
        """Return why a part was interrupted, and what the user can do about it."""
        if self._limit.is_hurried:
            return (
                f"{describe_interrupted_line(error)} had not returned {INTERRUPT_GRACE_S:g} s after the "
                "run received the signal to stop"
            )
        return (
            f"{describe_interrupted_line(error)} took longer than {self._limit.limit_s:g} s in one tick; if it needs "
            "so long, allow it with --set start_limit_s=600"
        )
