"""Measures joint modules whose host ends or is silent: their watchdogs must stop them.

The host is killed or frozen in a virtual machine, which has a CAN bus of the kernel. The modules on this bus continue
without the host: they are emulated in a process that runs during all trials, at 25 Hz. A listener records every frame
with the kernel's time. Host and control are the product's own processes.
"""

import contextlib
import multiprocessing
import os
import random
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from snakesim_can_backend.protocol.definitions import LastStop, ModuleState, Opcode, parse_node
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.programs import host_program
from snakesim_testing.can.listened_bus import (
    JOINT_COUNT,
    NODES,
    RATE_HZ,
    ReceivedFrame,
    RobotOnBus,
    find_first_reports,
    measure_module_duration_ms,
    open_robot_on_bus,
    select_stop_commands,
)
from snakesim_testing.can.module_rig import (
    BOOTED_AT_US,
    RESTING_READINGS,
    US_PER_MS,
    ModuleFirmware,
    arm_module,
    make_setpoint,
)
from verification.faults.observer import Observer, TrialError
from verification.faults.row import InjectionTrial, MeasurementRequest

CHANNEL = "vcan0"
ARMING_TIMEOUT_S = 120.0
MOVING_S = 0.3  # from arming to the injection
# After the signal. Includes the heartbeats after the stop, from which the time of the modules is known.
OBSERVED_S = 0.8
MAX_RETRIES = 10  # of each trial, on average
POLL_PERIOD_S = 0.4  # long, because an emulated machine needs its time for the modules and the host

# A single module.
MODULE_PERIOD_US = 10 * US_PER_MS
POLL_PERIOD_US = US_PER_MS / 10
MAX_SILENCE_US = 1000 * US_PER_MS  # a module that is still armed then has no watchdog


# --- the host ends, with modules on the kernel's bus ---------------------------------------------------------------


def _measure_ended_host(
    number: signal.Signals, request: MeasurementRequest
) -> Iterator[InjectionTrial]:
    """Kill or freeze the host while the modules are armed. Each trial has a new host.

    Yields:
        Trials whose value is the time from the last setpoint to the fault of the module, in ms of the module's time.
    """
    rng = random.Random(7)
    fault_delays_ms: list[float] = []  # of the last module in each trial, by the kernel's clock
    trial_count = 0
    with open_robot_on_bus(request.folder, CHANNEL) as robot:
        robot.start_modules()
        robot.start_control()
        while trial_count < request.trials:
            trial = _run_ended_host_trial(request, robot, number, rng, fault_delays_ms)
            if trial is not None:
                trial_count += 1
                yield trial
                continue
            request.count_retries()
            if request.retried > MAX_RETRIES * request.trials:
                raise TrialError(
                    f"this machine is too busy: the robot stopped by itself {request.retried} times"
                )
    request.add_note(
        f"the real host process and control, {JOINT_COUNT} modules in a process of their own, at {RATE_HZ:g} Hz on "
        f"{CHANNEL}; from the signal to the last module's fault by the kernel's clock: at most "
        f"{max(fault_delays_ms, default=0):.0f} ms. Each trial begins with a new host that is armed by an operator"
    )


measure_killed_host = partial(_measure_ended_host, signal.SIGKILL)
measure_frozen_host = partial(_measure_ended_host, signal.SIGSTOP)


def _run_ended_host_trial(
    request: MeasurementRequest,
    robot: RobotOnBus,
    number: signal.Signals,
    rng: random.Random,
    fault_delays_ms: list[float],
) -> InjectionTrial | None:
    """Start and arm a host, and send it a signal. Return None if the trial must be repeated with a new host."""
    try:
        with _start_armed_host(request, robot) as host_pid:
            robot.listener.discard_frames()
            time.sleep(MOVING_S + rng.random() / RATE_HZ)
            signal_ns = time.time_ns()
            os.kill(host_pid, number)
            time.sleep(OBSERVED_S)
            return _judge_ended_host_trial(robot, signal_ns, fault_delays_ms)
    except TrialError as error:
        print(f"    repeated: {error}", flush=True)
        return None


def _judge_ended_host_trial(
    robot: RobotOnBus, signal_ns: int, fault_delays_ms: list[float]
) -> InjectionTrial | None:
    """Return the trial from the frames on the bus, or None if the robot had stopped before the signal.

    Args:
        robot: Robot with a listener on its bus.
        signal_ns: When the host got the signal, by the kernel's clock.
        fault_delays_ms: Gets the time from the signal to the last module's fault, by the kernel's clock.
    """
    frames = robot.listener.receive_frames()
    if not _was_moving(frames, signal_ns):
        return None
    faults = find_first_reports(frames, {ModuleState.FAULT}, signal_ns)
    if len(faults) < JOINT_COUNT:
        states = robot.listener.states()
        return InjectionTrial(
            value=None, failure=f"not all in fault {OBSERVED_S:g} s after the signal: {states}"
        )
    fault_delays_ms.append((max(frame.at_ns for frame in faults.values()) - signal_ns) / 1e6)
    causes = {
        frame.decode()["last_stop"] for frame in faults.values() if frame.opcode == Opcode.HEARTBEAT
    }
    other_causes = causes - {LastStop.WATCHDOG}
    delays_ms = [_measure_module_delay_ms(frames, node, faults[node]) for node in NODES]
    return InjectionTrial(
        value=max(delays_ms),
        failure=f"stopped by {causes}" if other_causes else "",
        recovered=True,
    )


def _measure_module_delay_ms(
    frames: Sequence[ReceivedFrame], node: int, fault: ReceivedFrame
) -> float:
    """Return the time from the last setpoint of a module to its fault, in ms of the module's own time."""
    setpoint_times_ns = [frame.at_ns for frame in frames if _is_setpoint(frame, node)]
    return measure_module_duration_ms(frames, node, max(setpoint_times_ns), fault.at_ns)


def _was_moving(frames: Sequence[ReceivedFrame], at_ns: int) -> bool:
    """Return whether every module got a setpoint in the last three periods before a time, and none a stop command."""
    recent_ns = at_ns - round(3e9 / RATE_HZ)
    recent = [frame for frame in frames if frame.at_ns > recent_ns]
    has_setpoints = all(any(_is_setpoint(frame, node) for frame in recent) for node in NODES)
    return has_setpoints and not select_stop_commands(recent)


def _is_setpoint(frame: ReceivedFrame, node: int) -> bool:
    return frame.opcode == Opcode.SET_POINT and parse_node(frame.frame.id) == node


@contextlib.contextmanager
def _start_armed_host(request: MeasurementRequest, robot: RobotOnBus) -> Iterator[int]:
    """Start a host in a new process, arm every module, and yield the process id of the host."""
    # A new process is forked from one that has imported everything, which takes long on an emulated machine.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=_run_host, args=(robot.host_arguments, robot.folder))
    process.start()
    try:
        settings = ConnectionSettings(robot.endpoint, robot.config.robot.name)
        with open_session(settings, connect_timeout_s=ARMING_TIMEOUT_S) as session:
            _arm_modules(request, robot, Observer(session))
            assert process.pid is not None
            yield process.pid
    finally:
        process.kill()
        process.join()


def _arm_modules(request: MeasurementRequest, robot: RobotOnBus, observer: Observer) -> None:
    """Arm the robot until every module reports that it is armed.

    Raises:
        TrialError: The modules were not armed within ARMING_TIMEOUT_S.
    """
    deadline_s = time.monotonic() + ARMING_TIMEOUT_S
    while robot.listener.states() != [ModuleState.ARMED] * JOINT_COUNT:
        if time.monotonic() > deadline_s:
            log_end = robot.read_log("host")[-300:]
            raise TrialError(
                f"not armed within {ARMING_TIMEOUT_S:g} s: {observer.describe_status()}; {log_end}"
            )
        if observer.get_lifecycle() != "armed":
            observer.arm(ARMING_TIMEOUT_S)
        robot.listener.discard_frames()
        observer.listen_for(POLL_PERIOD_S)
    request.count_retries(observer.failed_armings)


def _run_host(arguments: Sequence[str], folder: Path) -> None:
    """Run the host in this process, with its output in a log."""
    os.environ["XDG_STATE_HOME"] = str(folder)
    log = os.open(folder / "host.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    sys.exit(host_program.main([*arguments, "--parent", str(os.getppid())]))


# --- the host sends nothing, with the firmware of one module -------------------------------------------------------


def measure_silent_host(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Stop sending setpoints to the firmware of an armed module, after a random number of periods.

    Yields:
        Trials whose value is the time from the last setpoint to the fault, in ms of the module's own time.
    """
    rng = random.Random(8)
    for _ in range(request.trials):
        module: ModuleFirmware = arm_module()
        now_us = BOOTED_AT_US
        for count in range(rng.randrange(5, 40)):
            now_us += MODULE_PERIOD_US
            module.handle_sync(count, RESTING_READINGS)
            module.poll(now_us)
            module.receive_setpoint(make_setpoint(count), now_us)
        assert module.state == ModuleState.ARMED, module.state
        last_setpoint_us = now_us
        while module.state == ModuleState.ARMED and now_us - last_setpoint_us < MAX_SILENCE_US:
            now_us += POLL_PERIOD_US
            module.poll(now_us)
        failure = ""
        if module.state != ModuleState.FAULT:
            failure = f"the state of the module is {module.state.name}"
        yield InjectionTrial(value=(now_us - last_setpoint_us) / US_PER_MS, failure=failure)
