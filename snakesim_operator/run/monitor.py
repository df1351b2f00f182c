"""Monitors a running run: arms once, shows progress, and notices faults."""

import time
from collections.abc import Callable
from pathlib import Path

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Session
from snakesim_hal.service import START_LIMIT_S
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlState, Description, LifecycleRequest, Status, Trajectory, request_to_arm
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.results.run_ending import AT_GOAL
from snakesim_operator.run.ending import Ending
from snakesim_operator.run.patience import StartupTimeout
from snakesim_operator.run.process_faults import ProcessFaults
from snakesim_operator.run.processor_waits import ProcessorWaits
from snakesim_operator.run.progress import Progress
from snakesim_operator.run.supervisor import HOST, Supervisor

AFTER_FAULT_S = 1.5
POLL_S = 0.05
ARM_LIMIT_S = 10.0
RECORDER_LIMIT_S = 20.0  # once everything else is ready
WHO = "snakesim run"
AT_WORK = ("host", "control")  # between them a lease expires
KEEPS_UP = 0.95  # share of real time
SILENT_S = 10.0  # of the host, which says five times a second how it is
SILENCES = {"T": "was stopped by a signal", "R": "computes", "S": "waits in a call", "D": "waits for a device"}
LATE_TICKS = 10  # a process that was stopped for a while makes few of them


class RunMonitor:
    """Monitors one run over its network, until it is over."""

    def __init__(
        self,
        config: RunConfig,
        session: Session,
        supervisor: Supervisor,
        ending: Ending,
        say: Callable[[str], None],
        *,
        stay: bool,
        unchecked: bool = False,
    ) -> None:
        """stay: a fault does not end the run; a person clears it and arms again.

        unchecked: arm also without a check of its joints.
        """
        self._unchecked = unchecked
        self._session, self._supervisor = session, supervisor
        self._ending, self._say, self._stay = ending, say, stay
        self._control = session.reader(keys.CONTROL_STATE, ControlState)
        self._trajectory = session.reader(keys.TRAJECTORY, Trajectory) if config.mission.until_goal else None
        self._state: ControlState | None = None
        self._recorder_is_there = RECORDER not in supervisor.names
        self._recorder_due_s: float | None = None
        session.on_alive(self._recorder_came, keys.alive(RECORDER))
        self._faults = ProcessFaults(config, session, supervisor, say)
        self._progress = Progress(config)
        self._patience = StartupTimeout(config.services, config.start_limit_s)
        self._waits = ProcessorWaits(config.lease_ns * 1e-9)
        self._status: Status | None = None
        self._silent_polls = 0  # since the last status: a run that was stopped itself does not count
        self._robot: Description | None = None
        self._armed = False  # once, by this run or by a person
        self._may_arm = config.has_own_control  # until the first fault: then a person does
        self._own_services = frozenset(config.own_services)
        self._hosts = supervisor.hosts
        self._asked_at: float | None = None
        self._last_latched: str | None = None
        self._silent = ""  # how, if it is

    def go(self) -> None:
        """Until the run is over. Raises SnakesimError when it cannot go on."""
        give_up = time.monotonic() + START_LIMIT_S
        with self._progress:
            try:
                while self._supervisor.goes_on() and not self._ending.interrupted:
                    self._take_in()
                    self._see_to_faults()
                    if self._ending.reason is not None and (self._over_before_it_began() or self._silent):
                        break
                    self._arm_once()
                    self._finish_at_goal()
                    if not self._armed and self._may_arm and (tired := self._tired(give_up)):
                        self._ending.because(tired)
                        break
                    time.sleep(POLL_S)
                if self._ending.reason is not None and self._armed and not self._ending.interrupted:
                    self._let_it_settle()
            finally:
                self._faults.undo()

    def _tired(self, give_up: float) -> str | None:
        """Why the run no longer waits to be armed; None: it does."""
        now, why = time.monotonic(), self._status.why if self._status else "no status"
        if self._patience.ends(self._status, now):
            limit_s = self._patience.limit_s
            return f"not ready to arm within {limit_s:g} s (start_limit_s) with every service there: {why}"
        return f"not ready to arm within {START_LIMIT_S:.0f} s: {why}" if now > give_up else None

    def _take_in(self) -> None:
        """Process arrived messages."""
        self._supervisor.take_in()
        if self._ending.reason is None:
            self._waits.look({name: pid for name, pid in self._supervisor.pids().items() if name in AT_WORK})
        if self._hosts != self._supervisor.hosts:
            self._hosts = self._supervisor.hosts
            self._may_arm = False
            self._progress.start_over()
            self._asked_at = None
        host, before = self._supervisor.host, self._status
        described_before = self._robot
        self._status, self._robot = (None, None) if host is None else (host.status, host.description)
        if self._robot is not None and described_before is None:
            self._say(describe_what_moves(self._robot))
        self._silent_polls = self._silent_polls + 1 if self._status is not None and self._status is before else 0
        self._state = self._control.newest(lambda _state: True) or self._state
        self._progress.show(self._status, self._state, armed=self._armed)

    def _see_to_faults(self) -> None:
        """Carry out injected faults, and detect real ones."""
        status = self._status
        if self._robot is not None and not self._armed:
            refusal = self._faults.refusal(self._robot)
            if refusal is not None:
                raise RefusedError(refusal)
        self._faults.carry_out(self._robot, status.lifecycle if status is not None else "disarmed")
        if status is None:
            return
        if status.lifecycle in ("fault", "estop"):
            self._may_arm = False
        self._armed |= status.lifecycle == "armed"
        before, self._silent = self._silent, self._silence(status)
        if self._stay:
            if self._silent and not before:
                self._say(self._silent)
            self._tell(status)
        elif self._silent:
            self._ending.because(self._silent)
        elif stopping := [fault for fault in status.faults if fault.reach == "robot"]:
            self._ending.because(stopping[0].cause)
            if stopping[0].what == "lease_expired" and (slow := self._too_slow(status)):
                self._ending.because(slow, first=True)

    def _too_slow(self, status: Status) -> str | None:
        """That this computer is too slow for the run, by what was measured; None: it is not, or nothing shows it."""
        shown: list[str] = []
        if (wait := self._waits.longest()) is not None:
            name, waited_s, lasted_s = wait
            shown.append(f"{name} waited for a processor for {1e3 * waited_s:.0f} of {1e3 * lasted_s:.0f} ms")
        factor = status.real_time_factor
        if status.overruns >= LATE_TICKS and status.speed == 1.0 and factor is not None and factor < KEEPS_UP:
            shown.append(f"{status.overruns} ticks were late, and robot time passed at {factor:.2f} of real time")
        return f"this computer is too slow: {', '.join(shown)}" if shown else None

    def _silence(self, status: Status) -> str:
        """That the host's process lives and says nothing; empty: it speaks, or has ended."""
        if self._silent_polls * POLL_S < SILENT_S or not self._supervisor.host_runs():
            return ""
        stat = Path(f"/proc/{self._supervisor.pids()[HOST]}/stat").read_text()
        how = SILENCES.get(stat.rpartition(")")[2].split()[0], "is there")
        return f"the host has said nothing for {SILENT_S:g} s, since tick {status.tick}; its process {how}"

    def _over_before_it_began(self) -> bool:
        return not self._armed and not self._may_arm

    def _tell(self, status: Status) -> None:
        """Print once how to recover from a fault."""
        latched = f"{status.lifecycle}: {status.why}" if status.lifecycle in ("fault", "estop") else None
        if latched is not None and latched != self._last_latched:
            self._say(latched)
            self._say(f"  go on with `snakesim clear`, then `snakesim arm {status.robot} {status.backend}`")
        self._last_latched = latched

    def _arm_once(self) -> None:
        status = self._status
        if status is None:
            return
        if self._own_services.isdisjoint(status.waiting_for):
            self._supervisor.came_up = True
        if self._armed or not self._may_arm or not status.ready_to_arm or self._robot is None:
            return
        if self._waits_for_recorder():
            return
        self._ask_to_arm(self._robot)

    def _finish_at_goal(self) -> None:
        """Ask once, when navigation says that the goal of a run that lasts until then is reached."""
        host = self._supervisor.host
        if self._trajectory is None or not self._armed or host is None:
            return
        if self._trajectory.newest(lambda trajectory: trajectory.finished) is not None:
            host.ask(LifecycleRequest(action="finish", who=AT_GOAL))
            self._trajectory = None

    def _waits_for_recorder(self) -> bool:
        """A recording has every tick, unless the recorder does not come."""
        if self._recorder_is_there or RECORDER in self._supervisor.lost:
            return False
        self._recorder_due_s = self._recorder_due_s or time.monotonic() + RECORDER_LIMIT_S
        if time.monotonic() < self._recorder_due_s:
            return True
        self._say(f"warning: no recorder within {RECORDER_LIMIT_S:.0f} s; the run goes on without")
        self._recorder_is_there = True
        return False

    def _recorder_came(self, _key: str, present: bool) -> None:
        """In Zenoh's thread: it misses nothing from now on."""
        self._recorder_is_there |= present

    def _ask_to_arm(self, robot: Description) -> None:
        """Over the private channel, which reaches only the host that this run has started."""
        host = self._supervisor.host
        assert host is not None
        if self._asked_at is None:
            host.ask(request_to_arm(robot, WHO, unchecked=self._unchecked))
            self._asked_at = time.monotonic()
        elif host.answers:
            answer, self._asked_at = host.answers.pop(0), None
            if not answer.ok and answer.refusal != "not_ready":
                raise RefusedError(answer.reason)
            self._armed = answer.ok
        elif time.monotonic() - self._asked_at > ARM_LIMIT_S:
            raise NotConnectedError(f"the host does not answer within {ARM_LIMIT_S:.0f} s; see host.log")

    def _let_it_settle(self) -> None:
        """After a failure keep the host running briefly, so that the safe stop is in the record and in `status`."""
        deadline = time.monotonic() + 2 * AFTER_FAULT_S
        while self._supervisor.host_runs() and time.monotonic() < deadline and not self._ending.interrupted:
            self._take_in()
            time.sleep(POLL_S)
        self._blame_slow_controller()

    def _blame_slow_controller(self) -> None:
        """Name the controller as the cause of an expired lease. Its own message comes after the fault."""
        status, state = self._status, self._state
        if status is None or state is None or not state.too_slow:
            return
        if any(fault.what == "lease_expired" for fault in status.faults):
            self._ending.because(f"control: {state.too_slow}", first=True)
