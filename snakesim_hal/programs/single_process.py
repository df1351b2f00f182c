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
from snakesim_hal.base.step_limit import (
    SharedStepTimes,
    StepTooLongError,
    StepWatchdog,
    describe_interrupted_line,
)
from snakesim_hal.base.terminal import report_error
from snakesim_hal.faults.allowed import create_host_faults
from snakesim_hal.host.host import Host, HostOptions
from snakesim_hal.model.fault_plan import parse_planned_faults
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.local_network import LocalNetwork
from snakesim_hal.programs.host_program import open_backend
from snakesim_hal.programs.preflight import (
    apply_backend_modes,
    load_backend_class,
    load_service_class,
)
from snakesim_hal.service import SERVICE_START_LIMIT_S, ServiceLoop
from snakesim_hal.wire.messages import make_arm_request

END_AFTER_FAULT_S = 1.5
ARM_TIMEOUT_S = 10.0  # the run gives up after this time and this number of turns:
MIN_TURNS_BEFORE_ARM_TIMEOUT = 100  # planning, or a busy computer, may need long for one turn
# Of one part in one turn; a part that needs longer is assumed to compute without end.
TURN_TIMEOUT_S = 60.0
INTERRUPT_GRACE_PERIOD_S = 1.0  # of the present turn of a part, after Ctrl-C
HOST_ENDED = object()  # the host has no further turn
REQUESTER = "run in one process"  # of the arming


def validate_single_process_config(config: RunConfig) -> None:
    """Raise ConfigError if a run needs several processes, real time or a network."""
    context = f"scenario {config.name!r} in one process"
    if config.clock_mode != "lockstep":
        raise ConfigError(
            f"{context}: clock mode is {config.clock_mode!r}, must be 'lockstep'; add --clock-mode lockstep",
            code="backend/wrong-clock-mode",
        )
    if not config.has_internal_control:
        raise ConfigError(
            f"{context}: no controller commands the robot; it needs a control service that is not external",
            code="config/conflict",
        )
    for name, service in config.services.items():
        if service.external:
            raise ConfigError(
                f"{context}: services.{name} is external, and there is no network to meet it",
                code="config/conflict",
            )
    for injection in parse_planned_faults(config):
        if injection.target_type in ("process", "clock"):
            raise ConfigError(
                f"{context}: fault {str(injection)!r} needs processes of their own",
                code="injection/not-supported",
            )


class InProcessRun:
    """One run in this process. Its `with` opens and closes the backend and all services.

    Attributes:
        config: The configuration, limited to what the drives of its backend can do and measure.
    """

    def __init__(
        self,
        config: RunConfig,
        step_times: SharedStepTimes | None = None,
        turn_limit_s: float | None = None,
    ) -> None:
        """Check the configuration. The `with` block opens the backend and all services.

        Args:
            config: Configuration of the run.
            step_times: Shared memory that shows start and deadline of the current turn to another process. None if no
                other process needs to know.
            turn_limit_s: Maximum wall time of a part in one turn. None for the larger one of TURN_TIMEOUT_S and
                `start_limit_s` of the configuration.

        Raises:
            ConfigError: The run needs several processes, real time or a network; or its backend cannot drive the robot.
        """
        validate_single_process_config(config)
        self._backend_class = load_backend_class(config.backend)
        # A host that awaits a torque that no drive measures would never be ready to arm.
        self.config = apply_backend_modes(config, self._backend_class)
        self._watchdog = StepWatchdog(SERVICE_START_LIMIT_S, step_times)
        self._turn_timeout_s = turn_limit_s or max(TURN_TIMEOUT_S, config.start_limit_s)
        self.network = LocalNetwork()
        self.failed_services: list[str] = []  # texts about services that ended with an error
        self._error_by_service: dict[str, SnakesimError] = {}
        self._loop_by_service: dict[str, ServiceLoop] = {}
        self._exit_stack_by_service: dict[str, ExitStack] = {}
        self._exit_stack = ExitStack()

    def __enter__(self) -> Self:
        """Open the backend and all services. Raises SnakesimError."""
        with ExitStack() as opening:
            try:
                with self._watchdog:
                    self._open(opening)
            except StepTooLongError as error:
                raise RefusedError(
                    f"the run did not begin: {self._explain_interruption(error)}",
                    code="backend/step-timeout",
                ) from error
            self._exit_stack = opening.pop_all()
        self._watchdog.step_timeout_s = self._turn_timeout_s
        return self

    def __exit__(self, *_error: object) -> None:
        self._watchdog.close()
        self._exit_stack.close()

    def _open(self, opened: ExitStack) -> None:
        """Open the backend, the host and all services, each to be closed by the stack.

        Raises:
            RefusedError: The backend moves real hardware.
        """
        # Services in their own processes use one thread, too. Several threads would round sums differently.
        opened.enter_context(threadpool_limits(1))
        self._open_host(opened)
        for name in self.config.services:
            self._open_service(name, opened)

    def _open_host(self, opened: ExitStack) -> None:
        """Open the emulated backend, and create the HAL host on the network of this process.

        Args:
            opened: Exit stack to which everything is added that has to be closed at the end of the run.

        Raises:
            RefusedError: The backend moves real hardware.
        """
        config = self.config
        backend = open_backend(self._backend_class, config)
        opened.callback(backend.close)
        if not backend.describe().emulated:
            raise RefusedError(
                f"backend {config.backend!r} moves real hardware, which could not be stopped from outside: run it in "
                "processes of their own",
                code="robot/real-hardware",
            )
        session = self.network.create_session()
        opened.callback(session.close)
        backend_with_faults, faults = create_host_faults(config, backend, session)
        options = HostOptions(
            max_ticks=round(config.duration_s * config.rate_hz),
            end_after_fault_s=END_AFTER_FAULT_S,
            clock_mode_after_fault="free",
            faults=faults,
        )
        self.host = Host(config, backend_with_faults, session, options)
        self.network.run_responders = self.host.handle_queued_input
        opened.callback(self.network.close)

    def _open_service(self, name: str, opened: ExitStack) -> None:
        """Create the loop of a service. It is closed by the stack, or earlier when the service fails."""
        service_stack = opened.enter_context(ExitStack())
        session = self.network.create_session()
        service_stack.callback(session.close)
        loop = ServiceLoop(load_service_class(self.config, name), self.config, session)
        service_stack.callback(loop.close)
        self._exit_stack_by_service[name] = service_stack
        self._loop_by_service[name] = loop

    def iterate_ticks(self, *, before_services: bool = False) -> Generator[None]:
        """Run the host and all services in turn, tick by tick, and arm the robot when it is ready.

        Args:
            before_services: If True, yield after the samples of a tick are published, before any service has read them.
                If False, yield after the turn of all services.

        Yields:
            None in each turn, also before the robot is armed. When the generator ends or is closed, the joints are
            safe.

        Raises:
            RefusedError: The robot is not ready to arm in time.
            SnakesimError: The run cannot continue.
        """
        arm_timeout_s = min(ARM_TIMEOUT_S, self.config.start_limit_s)
        arm_deadline_s = time.monotonic() + arm_timeout_s
        with closing(self.host.iterate_ticks()) as host_turns:
            for turn in itertools.count():
                # The backend may be third-party code, and turns this into an error of its own.
                with self._watchdog:
                    if next(host_turns, HOST_ENDED) is HOST_ENDED:
                        return
                if turn == 0:
                    for loop in self._loop_by_service.values():
                        loop.connect()
                if before_services:
                    yield
                self._step_services()
                if not self.host.authority.arm_session and not self.failed_services:
                    is_too_late = (
                        turn > MIN_TURNS_BEFORE_ARM_TIMEOUT and time.monotonic() > arm_deadline_s
                    )
                    self._arm_when_ready(is_too_late, arm_timeout_s)
                if not before_services:
                    yield

    def _arm_when_ready(self, is_too_late: bool, timeout_s: float) -> None:
        """Request the arming if the robot is ready. Raises RefusedError if it is too late for that."""
        status = self.host.build_status()
        if is_too_late:
            raise RefusedError(
                f"not ready to arm within {timeout_s:g} s: {status.reason}", code="robot/not-ready"
            )
        if status.ready_to_arm:
            self.host.submit_request(
                make_arm_request(self.host.description, REQUESTER), lambda _answer: None
            )

    def stop(self) -> None:
        """End the run in order."""
        self.host.request_stop()

    def pop_errors(self) -> dict[str, SnakesimError]:
        """Return the error that ended each service, by name, and forget the errors.

        The traceback of an error refers to this run. If the run also held the error, neither could be freed.
        """
        errors = self._error_by_service
        self._error_by_service = {}
        return errors

    def list_slow_services(self) -> list[str]:
        """Return the services that were too slow for real time, each with the measurement that shows it."""
        slow_services: list[str] = []
        for name, loop in self._loop_by_service.items():
            if loop.service.too_slow:
                slow_services.append(f"{name}: {loop.service.too_slow}")
        return slow_services

    def interrupt_after_grace_period(self) -> None:
        """Interrupt a part that does not return within INTERRUPT_GRACE_PERIOD_S. May be called by a signal handler."""
        self._watchdog.request_shutdown(INTERRUPT_GRACE_PERIOD_S)

    def _step_services(self) -> None:
        """Run the turn of every service. A service that raises an error is closed, as its process would end."""
        for name, loop in list(self._loop_by_service.items()):
            try:
                self._step_with_time_limit(loop)
            except SnakesimError as error:
                report_error(error, f"snakesim {name}")
                self._error_by_service[name] = error
                self.failed_services.append(f"{name} ended: {error}")
                del self._loop_by_service[name]
                self._exit_stack_by_service[name].close()

    def _step_with_time_limit(self, loop: ServiceLoop) -> None:
        """Run the turn of a service. Raises ServiceError if the turn takes too long."""
        try:
            with self._watchdog:
                loop.step()
        except StepTooLongError as error:
            traceback.print_exc()
            raise ServiceError(
                self._explain_interruption(error), code="backend/step-timeout"
            ) from None

    def _explain_interruption(self, error: StepTooLongError) -> str:
        """Return why a part was interrupted, and what the user can do about it."""
        if self._watchdog.is_shutting_down:
            return (
                f"{describe_interrupted_line(error)} had not returned {INTERRUPT_GRACE_PERIOD_S:g} s after the "
                "run received the signal to stop"
            )
        return (
            f"{describe_interrupted_line(error)} took longer than {self._watchdog.step_timeout_s:g} s in one tick; "
            "if it needs so long, allow it with --set start_limit_s=600"
        )
