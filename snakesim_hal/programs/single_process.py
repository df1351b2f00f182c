"""A whole run in one process and one thread, without a network: host, guidance, navigation and control take turns.

    with InProcessRun(config) as run:
        for _ in run.iterate_ticks():
            ...  # once a tick; run.host.authority, run.network.session() for readers, run.stop()
    record_of(run.host).command_digest

The parts are those of a run in lockstep: the same host with its authority, the same services, the same bytes between
them. So a configuration drives the motors alike in both, to the bit. What needs processes or a network is refused.
"""

import itertools
import time
import traceback
from collections.abc import Generator
from contextlib import ExitStack, closing
from typing import Self

from threadpoolctl import threadpool_limits

from snakesim_hal.base.errors import ConfigError, RefusedError, ServiceError, SnakesimError
from snakesim_hal.base.step_limit import Pulse, StepLimit, StepTooLongError, describe_interrupted_line
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
ARM_LIMIT_S, ARM_LIMIT_TURNS = 10.0, 100  # both: planning, or a busy computer, may take long for a turn
TURN_LIMIT_S = 60.0  # of one part in one turn; beyond, it computes without end
INTERRUPT_GRACE_S = 1.0  # of the present turn of a part, after Ctrl-C
OVER = object()
WHO = "run in one process"


def check(config: RunConfig) -> None:
    """Whether a run needs neither processes of its own nor a network. Raises ConfigError."""
    where = f"scenario {config.name!r} in one process"
    if config.clock_mode != "lockstep":
        raise ConfigError(
            f"{where}: clock mode is {config.clock_mode!r}, must be 'lockstep'; add --clock-mode lockstep",
            code="backend/wrong-clock-mode",
        )
    if not config.has_own_control:
        raise ConfigError(
            f"{where}: nobody commands the robot; it needs a control service that is not external",
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
    """One run, from `with` to its end."""

    def __init__(self, config: RunConfig, pulse: Pulse | None = None, turn_limit_s: float | None = None) -> None:
        """Check the configuration.

        Args:
            config: of the run.
            pulse: shows another process whether the run goes on.
            turn_limit_s: wall time that a part may take in one turn, if not as the configuration says.

        Raises:
            ConfigError: the run needs more than one process.
        """
        check(config)
        self.config = config
        self._limit = StepLimit(SERVICE_START_LIMIT_S, pulse)
        self._turn_limit_s = turn_limit_s or max(TURN_LIMIT_S, config.start_limit_s)
        self.network = LocalNetwork()
        self.failed: list[str] = []  # services that could not go on, and why
        self._errors: dict[str, SnakesimError] = {}  # what ended them
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
        config = self.config
        # As in processes of their own: sums of several threads are rounded otherwise, and the digest would differ.
        opened.enter_context(threadpool_limits(1))
        backend = open_backend(find_backend(config.backend), config)
        opened.callback(backend.close)
        if not backend.describe().emulated:
            raise RefusedError(
                f"backend {config.backend!r} moves real hardware, which nobody could stop from outside: run it in "
                "processes of their own",
                code="robot/real-hardware",
            )
        session = self.network.session()
        opened.callback(session.close)
        faulty, faults = create_host_faults(config, backend, session)
        options = HostOptions(
            max_ticks=round(config.duration_s * config.rate_hz),
            end_after_fault_s=AFTER_FAULT_S,
            clock_mode_after_fault="free",
            faults=faults,
        )
        self.host = Host(config, faulty, session, options)
        self.network.answer = self.host.handle_queued_input
        opened.callback(self.network.close)
        for name in config.services:
            part = self._parts[name] = opened.enter_context(ExitStack())
            session = self.network.session()
            part.callback(session.close)
            loop = self._loops[name] = ServiceLoop(find_service(config, name), config, session)
            part.callback(loop.close)

    def iterate_ticks(self, *, before_services: bool = False) -> Generator[None]:
        """Run. Yields after each turn of all parts, also before the arming. Raises SnakesimError when it cannot begin.

        before_services: yields instead when the samples of a tick are out, and no service has acted on them.

        The joints are safe at the end, also when this generator is closed early.
        """
        limit_s = min(ARM_LIMIT_S, self.config.start_limit_s)
        give_up = time.monotonic() + limit_s
        with closing(self.host.iterate_ticks()) as turns:
            for turn in itertools.count():
                with self._limit:  # the backend may be third-party code, and turns this into an error of its own
                    if next(turns, OVER) is OVER:
                        return
                if turn == 0:
                    for loop in self._loops.values():
                        loop.join()
                if before_services:
                    yield
                self._let_act()
                if not self.host.authority.arm_session and not self.failed:
                    status = self.host.status()
                    if turn > ARM_LIMIT_TURNS and time.monotonic() > give_up:
                        raise RefusedError(
                            f"not ready to arm within {limit_s:g} s: {status.reason}", code="robot/not-ready"
                        )
                    if status.ready_to_arm:
                        self.host.submit_request(make_arm_request(self.host.description, WHO), lambda _answer: None)
                if not before_services:
                    yield

    def stop(self) -> None:
        """End the run in order."""
        self.host.stop()

    def take_errors(self) -> dict[str, SnakesimError]:
        """Return what ended each service that could not go on, and forget it.

        A traceback holds this run, and the run must not hold the traceback too: nothing would release them.
        """
        taken = self._errors
        self._errors = {}
        return taken

    def too_slow(self) -> list[str]:
        """Return the services that could not keep up in real time, and what shows it."""
        loops = self._loops.items()
        return [f"{name}: {loop.service.too_slow}" for name, loop in loops if loop.service.too_slow]

    def hurry(self) -> None:
        """Wait no longer for a part that does not return. May be called by a signal handler."""
        self._limit.hurry(INTERRUPT_GRACE_S)

    def _let_act(self) -> None:
        for name, loop in list(self._loops.items()):
            try:
                self._act_in_time(loop)
            except SnakesimError as error:  # its process would end here, and the host would go on
                report_error(error, f"snakesim {name}")
                self._errors[name] = error
                self.failed.append(f"{name} ended: {error}")
                del self._loops[name]
                self._parts[name].close()

    def _act_in_time(self, loop: ServiceLoop) -> None:
        try:
            with self._limit:
                loop.act()
        except StepTooLongError as error:
            traceback.print_exc()
            raise ServiceError(self._explain(error), code="backend/step-timeout") from None

    def _explain(self, error: StepTooLongError) -> str:
        """Return why a part was interrupted, and what to do about it."""
        if self._limit.is_hurried:
            return (
                f"{describe_interrupted_line(error)} had not returned {INTERRUPT_GRACE_S:g} s after the "
                "run was told to stop"
            )
        return (
            f"{describe_interrupted_line(error)} took longer than {self._limit.limit_s:g} s in one tick; if "
            "it needs so long, allow it "
            "with --set start_limit_s=600"
        )
