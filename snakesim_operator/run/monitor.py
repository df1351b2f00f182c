"""Monitors a running run: arms once, shows progress, and notices faults."""

import time
from collections.abc import Callable
from pathlib import Path

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Session
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    ControlState,
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
    Trajectory,
    make_arm_request,
)
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.results.run_ending import GOAL_REQUESTER
from snakesim_operator.run.arming_timeout import StartupTimeout
from snakesim_operator.run.ending import RunEnding
from snakesim_operator.run.processes.process_faults import ProcessFaults
from snakesim_operator.run.processes.processor_waits import ProcessorWaits
from snakesim_operator.run.processes.supervisor import HOST, RunSupervisor
from snakesim_operator.run.progress import RunProgress

# The host continues for so long after a fault, so that the safe stop is in the record.
RUN_ON_AFTER_FAULT_S = 1.5
POLL_S = 0.05
ARM_TIMEOUT_S = 10.0  # for the response of the host to the request to arm
RECORDER_TIMEOUT_S = 20.0  # once everything else is ready
REQUESTER = "snakesim run"
# The lease expires if one of these two waits too long for a processor.
LEASE_PROCESSES = "host", "control"
MIN_REAL_TIME_FACTOR = 0.95  # below it, the computer does not keep up
MIN_LATE_TICKS = 10  # a process that was only stopped for a while causes fewer late ticks
MAX_SILENCE_S = 10.0  # the host sends its status five times a second
PROCESS_STATES = {
    "T": "was stopped by a signal",
    "R": "computes",
    "S": "waits in a call",
    "D": "waits for a device",
}


class RunMonitor:
    """Monitors one run over its network, until it is over."""

    def __init__(
        self,
        config: RunConfig,
        session: Session,
        supervisor: RunSupervisor,
        ending: RunEnding,
        print_text: Callable[[str], None],
        *,
        stay: bool,
        unchecked: bool = False,
    ) -> None:
        """Subscribe to the messages of the run.

        Args:
            config: Configuration of the run.
            session: Session on the network of the run.
            supervisor: Supervisor of the processes of the run, which are already started.
            ending: Collects the causes of the end of the run.
            print_text: Prints a line for the operator.
            stay: Whether a fault does not end the run; a person resets the fault and arms again.
            unchecked: Whether to arm a robot whose joints have not been checked.
        """
        # Collaborators.
        self._session = session
        self._supervisor = supervisor
        self._ending = ending
        self._print_text = print_text
        self._stay = stay
        self._unchecked = unchecked
        self._faults = ProcessFaults(config, session, supervisor, print_text)
        self._progress = RunProgress(config)
        self._startup_timeout = StartupTimeout(config.services, config.start_limit_s)
        self._processor_waits = ProcessorWaits(config.lease_ns * 1e-9)

        # What control and navigation published.
        self._control_states = session.declare_reader(keys.CONTROL_STATE, ControlState)
        self._control_state: ControlState | None = None
        self._trajectory = (
            session.declare_reader(keys.TRAJECTORY, Trajectory)
            if config.mission.until_goal
            else None
        )

        # The recorder.
        self._recorder_is_ready = RECORDER not in supervisor.process_names
        self._recorder_due_s: float | None = None
        session.on_token_change(self._on_recorder_alive, keys.alive_key(RECORDER))

        # What the host published.
        self._status: RobotStatus | None = None
        self._robot: RobotDescription | None = None
        self._host_count = supervisor.host_count
        # Polls instead of time: a pause of this process is no silence of the host.
        self._polls_without_status = 0
        self._silence: str | None = None  # a sentence, if the host is silent
        self._last_latched: str | None = None  # the fault or emergency stop that was printed last

        # Arming.
        self._has_been_armed = False  # True after the first arming, by this run or by a person
        # Until the first fault; afterwards only a person arms.
        self._is_arming_allowed = config.has_internal_control
        self._own_services = frozenset(config.internal_services)
        self._arm_request_time_s: float | None = None

    def run(self) -> None:
        """Monitor the run until it is over. Raises SnakesimError when it cannot continue."""
        arming_deadline_s = time.monotonic() + SERVICE_START_LIMIT_S
        with self._progress:
            try:
                while (
                    self._supervisor.restart_ended_processes() and not self._ending.is_interrupted
                ):
                    if not self._poll(arming_deadline_s):
                        break
                    time.sleep(POLL_S)
                if (
                    self._ending.reason is not None
                    and self._has_been_armed
                    and not self._ending.is_interrupted
                ):
                    self._wait_for_safe_stop()
            finally:
                self._faults.undo_all()

    def _poll(self, arming_deadline_s: float) -> bool:
        """Read messages, handle faults, and arm when the robot is ready. Returns whether the run continues."""
        self._read_messages()
        self._handle_faults()
        failed_before_arming = not self._has_been_armed and not self._is_arming_allowed
        if self._ending.reason is not None and (failed_before_arming or self._silence is not None):
            return False
        self._arm_once()
        self._finish_at_goal()
        if self._has_been_armed or not self._is_arming_allowed:
            return True
        timeout = self._describe_timeout(arming_deadline_s)
        if timeout is None:
            return True
        self._ending.add_cause(timeout)
        return False

    def _describe_timeout(self, arming_deadline_s: float) -> str | None:
        """Describe why the run stops waiting to arm the robot; None while it waits."""
        now_s = time.monotonic()
        reason = self._status.reason if self._status else "no status"
        if self._startup_timeout.update_and_check_expired(self._status, now_s):
            timeout_s = self._startup_timeout.timeout_s
            return f"not ready to arm within {timeout_s:g} s (start_limit_s) with every service there: {reason}"
        if now_s > arming_deadline_s:
            return f"not ready to arm within {SERVICE_START_LIMIT_S:.0f} s: {reason}"
        return None

    def _read_messages(self) -> None:
        """Process the messages that have arrived, and update the progress line."""
        self._supervisor.read_host_messages()
        if self._ending.reason is None:
            self._sample_processor_waits()
        if self._host_count != self._supervisor.host_count:
            self._on_new_host()
        self._read_host()
        newest_state = self._control_states.pop_newest(lambda _state: True)
        self._control_state = newest_state or self._control_state
        self._progress.update(self._status, self._control_state, armed=self._has_been_armed)

    def _sample_processor_waits(self) -> None:
        pids = self._supervisor.get_pids()
        self._processor_waits.take_sample(
            {name: pids[name] for name in pids if name in LEASE_PROCESSES}
        )

    def _on_new_host(self) -> None:
        """Start over with a host that was restarted or reset. It boots disarmed, and a person arms it."""
        self._host_count = self._supervisor.host_count
        self._is_arming_allowed = False
        self._progress.reset()
        self._arm_request_time_s = None

    def _read_host(self) -> None:
        """Update status and description from the private channel, and count polls without a new status."""
        previous_status = self._status
        previous_robot = self._robot
        host = self._supervisor.host
        if host is None:
            self._status = None
            self._robot = None
        else:
            self._status = host.status
            self._robot = host.description
        if self._robot is not None and previous_robot is None:
            self._print_text(describe_what_moves(self._robot))
        if self._status is not None and self._status is previous_status:
            self._polls_without_status += 1
        else:
            self._polls_without_status = 0

    def _handle_faults(self) -> None:
        """Inject the faults that are due, and end the run if the robot has a fault or is silent.

        With `--stay`, faults and silence are only printed, because the user resets and arms the robot.
        """
        status = self._status
        if self._robot is not None and not self._has_been_armed:
            refusal = self._faults.describe_refusal(self._robot)
            if refusal is not None:
                raise RefusedError(refusal, code="injection/not-allowed")
        self._faults.apply_due_faults(
            self._robot, status.lifecycle if status is not None else "disarmed"
        )
        if status is None:
            return
        if status.lifecycle in ("fault", "estop"):
            self._is_arming_allowed = False
        if status.lifecycle == "armed":
            self._has_been_armed = True
        previous_silence = self._silence
        self._silence = self._describe_silence(status)
        if self._stay:
            if self._silence is not None and previous_silence is None:
                self._print_text(self._silence)
            self._print_recovery(status)
        elif self._silence is not None:
            self._ending.add_cause(self._silence)
        else:
            self._note_robot_fault(status)

    def _note_robot_fault(self, status: RobotStatus) -> None:
        """Note the first fault that stops the whole robot as the reason for the end of the run."""
        fault = next((fault for fault in status.faults if fault.scope == "robot"), None)
        if fault is None:
            return
        self._ending.add_cause(fault.cause)
        if fault.what == "lease_expired":
            slow = self._describe_slow_computer(status)
            if slow is not None:
                self._ending.add_cause(slow, first=True)

    def _describe_slow_computer(self, status: RobotStatus) -> str | None:
        """Describe the measurements that show that this computer is too slow for the run; None if there are none."""
        evidence: list[str] = []
        wait = self._processor_waits.find_longest()
        if wait is not None:
            name, waited_s, window_s = wait
            evidence.append(
                f"{name} waited for a processor for {1e3 * waited_s:.0f} of {1e3 * window_s:.0f} ms"
            )
        factor = status.real_time_factor
        many_late_ticks = status.overruns >= MIN_LATE_TICKS and status.speed == 1.0
        if many_late_ticks and factor is not None and factor < MIN_REAL_TIME_FACTOR:
            evidence.append(
                f"{status.overruns} ticks were late, and robot time passed at {factor:.2f} of real time"
            )
        if not evidence:
            return None
        return f"this computer is too slow: {', '.join(evidence)}"

    def _describe_silence(self, status: RobotStatus) -> str | None:
        """Describe that the host runs but sends no status; None if it sends its status, or has ended."""
        if (
            self._polls_without_status * POLL_S < MAX_SILENCE_S
            or not self._supervisor.is_host_running()
        ):
            return None
        stat = Path(f"/proc/{self._supervisor.get_pids()[HOST]}/stat").read_text()
        state = stat.rpartition(")")[2].split()[0]
        activity = PROCESS_STATES.get(state, "is there")
        return f"the host has sent no status for {MAX_SILENCE_S:g} s, since tick {status.tick}; its process {activity}"

    def _print_recovery(self, status: RobotStatus) -> None:
        """Print a new fault or emergency stop once, and how to recover from it."""
        if status.lifecycle not in ("fault", "estop"):
            self._last_latched = None
            return
        latched = f"{status.lifecycle}: {status.reason}"
        if latched != self._last_latched:
            self._print_text(latched)
            self._print_text(
                f"  continue with `snakesim robot reset`, then `snakesim robot arm {status.robot} {status.backend}`"
            )
        self._last_latched = latched

    def _arm_once(self) -> None:
        """Arm the robot as soon as it is ready and the recorder is, if it has not been armed before."""
        status = self._status
        if status is None:
            return
        if self._own_services.isdisjoint(status.waiting_for):
            self._supervisor.has_started_up = True
        if (
            self._has_been_armed
            or not self._is_arming_allowed
            or not status.ready_to_arm
            or self._robot is None
        ):
            return
        if self._waits_for_recorder():
            return
        self._request_arming(self._robot)

    def _finish_at_goal(self) -> None:
        """Send one request to finish, when the mission ends at its goal and navigation reports that it is reached."""
        host = self._supervisor.host
        if self._trajectory is None or not self._has_been_armed or host is None:
            return
        if self._trajectory.pop_newest(lambda trajectory: trajectory.finished) is not None:
            host.send_request(LifecycleRequest(action="finish", requester=GOAL_REQUESTER))
            self._trajectory = None

    def _waits_for_recorder(self) -> bool:
        """Return whether arming waits for the recorder, so that the recording has every tick.

        A recorder that does not connect within RECORDER_TIMEOUT_S is not waited for.
        """
        if self._recorder_is_ready or RECORDER in self._supervisor.losses_by_process:
            return False
        now = time.monotonic()
        if self._recorder_due_s is None:
            self._recorder_due_s = now + RECORDER_TIMEOUT_S
        if now < self._recorder_due_s:
            return True
        self._print_text(
            f"warning: no recorder within {RECORDER_TIMEOUT_S:.0f} s; the run continues without"
        )
        self._recorder_is_ready = True
        return False

    def _on_recorder_alive(self, _key: str, present: bool) -> None:
        """Note that the recorder has subscribed and receives all further messages. Called in Zenoh's thread."""
        self._recorder_is_ready |= present

    def _request_arming(self, robot: RobotDescription) -> None:
        """Request arming over the private channel, which reaches only the host that this run has started."""
        host = self._supervisor.host
        assert host is not None
        if self._arm_request_time_s is None:
            host.send_request(make_arm_request(robot, REQUESTER, unchecked=self._unchecked))
            self._arm_request_time_s = time.monotonic()
        elif host.answers:
            response = host.answers.pop(0)
            self._arm_request_time_s = None
            if not response.ok and response.refusal != "not_ready":
                raise RefusedError(response.reason, code="robot/not-ready")
            self._has_been_armed = response.ok
        elif time.monotonic() - self._arm_request_time_s > ARM_TIMEOUT_S:
            raise NotConnectedError(
                f"the host does not answer within {ARM_TIMEOUT_S:.0f} s; see host.log"
            )

    def _wait_for_safe_stop(self) -> None:
        """Keep the host running briefly after a failure, so that the safe stop is in the record and in `status`."""
        deadline = time.monotonic() + 2 * RUN_ON_AFTER_FAULT_S
        while (
            self._supervisor.is_host_running()
            and time.monotonic() < deadline
            and not self._ending.is_interrupted
        ):
            self._read_messages()
            time.sleep(POLL_S)
        self._note_slow_controller()

    def _note_slow_controller(self) -> None:
        """Note the controller as the cause of an expired lease. Its own message arrives after the fault."""
        status = self._status
        state = self._control_state
        if status is None or state is None or not state.too_slow:
            return
        if any(fault.what == "lease_expired" for fault in status.faults):
            self._ending.add_cause(f"control: {state.too_slow}", first=True)
