"""What needs a machine of its own: modules on a kernel's CAN bus outlive the host, and the wall clock is set.

The modules are emulators in a process that lives through all trials, at 25 Hz; the listener has the kernel's time of
every frame. Host and control are the product's own processes.
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
from snakesim_hal.model.scenario import KeyOverride, load_scenario
from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.programs import host_program as host_process
from snakesim_testing.can.listened_bus import (
    JOINT_COUNT,
    NODES,
    RATE_HZ,
    SCENARIO,
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
from snakesim_testing.hal.small_robots import write_scenario_files
from verification.faults.observer import Observer, TrialError
from verification.faults.robot import START_LIMIT_S, ProcessRobot, robot
from verification.faults.row import InjectionTrial, MeasurementRequest

CHANNEL = "vcan0"
ARM_LIMIT_S = 120.0
LIVE_S = 0.3
LEFT_S = 0.8
MAX_RETRIES = 10  # of each trial, on average
LOOK_S = 0.4
WATCHDOG_MS = 100.0
STEP_S = 3600.0
AFTER_STEP_S = 1.0
ATTEMPTS = 3


def host_gone(number: signal.Signals, request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """SIGKILL or SIGSTOP for the host. The value: from the last setpoint to the fault, in the module's own time."""
    rng, by_kernel_ms, done = random.Random(7), list[float](), 0
    with open_robot_on_bus(request.folder, CHANNEL) as robot:
        robot.start_modules()
        robot.start_control()
        while done < request.trials:
            trial: InjectionTrial | None = None
            try:
                with _armed_host(request, robot) as pid:
                    robot.listener.discard_frames()
                    time.sleep(LIVE_S + rng.random() / RATE_HZ)
                    trial = _left_alone(robot, pid, number, by_kernel_ms)
            except TrialError as error:  # it could not be armed: with a new host, perhaps
                print(f"    made again: {error}", flush=True)
            if trial is not None:
                done += 1
                yield trial
                continue
            request.retry()
            if request.retried > MAX_RETRIES * request.trials:
                raise TrialError(
                    f"this machine is too busy: the robot stopped by itself {request.retried} times"
                )
    request.note(
        f"the real host process and control, {JOINT_COUNT} modules in a process of their own, at {RATE_HZ:g} Hz on "
        f"{CHANNEL}; from the signal to the last module's fault by the kernel's clock: at most "
        f"{max(by_kernel_ms, default=0):.0f} ms. Each trial begins with a new host that is armed by an operator"
    )


host_killed, host_frozen = (
    partial(host_gone, number) for number in (signal.SIGKILL, signal.SIGSTOP)
)


def _left_alone(
    robot: RobotOnBus, pid: int, number: signal.Signals, by_kernel_ms: list[float]
) -> InjectionTrial | None:
    """None: the robot had stopped already when the signal came."""
    listener, fault = robot.listener, {ModuleState.FAULT}
    now_ns = time.time_ns()
    os.kill(pid, number)
    # Also for the heartbeats after it, from which the modules' own time is known.
    time.sleep(LEFT_S)
    received = listener.receive_frames()
    if not _went_well_until(received, now_ns):
        return None
    stopped = find_first_reports(received, fault, now_ns)
    if len(stopped) < JOINT_COUNT:
        return InjectionTrial(
            value=None,
            failure=f"not all in fault {LEFT_S:g} s after the signal: {listener.states()}",
        )
    by_kernel_ms.append(max(h.at_ns for h in stopped.values()) / 1e6 - now_ns / 1e6)
    failures: list[str] = []
    causes = {h.decode()["last_stop"] for h in stopped.values() if h.opcode == Opcode.HEARTBEAT}
    if causes - {LastStop.WATCHDOG}:
        failures.append(f"stopped by {causes}")
    own_ms: list[float] = []
    for node in NODES:
        points = [
            h.at_ns
            for h in received
            if h.opcode == Opcode.SET_POINT and parse_node(h.frame.id) == node
        ]
        own_ms.append(measure_module_duration_ms(received, node, max(points), stopped[node].at_ns))
    return InjectionTrial(value=max(own_ms), failure="; ".join(failures), recovered=True)


def _went_well_until(received: Sequence[ReceivedFrame], now_ns: int) -> bool:
    """Return whether every module had a setpoint within the last three periods, and none had a stop command."""
    recent_ns = now_ns - round(3e9 / RATE_HZ)
    driven = {
        parse_node(h.frame.id)
        for h in received
        if h.opcode == Opcode.SET_POINT and recent_ns < h.at_ns
    }
    return driven == set(NODES) and not select_stop_commands(
        [h for h in received if h.at_ns > recent_ns]
    )


@contextlib.contextmanager
def _armed_host(request: MeasurementRequest, robot: RobotOnBus) -> Iterator[int]:
    """A host in a process of its own, once it has armed every module."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload([__name__])
    process = processes.Process(target=_become_host, args=(robot.host_arguments, robot.folder))
    process.start()
    try:
        link = ConnectionSettings(robot.endpoint, robot.config.robot.name)
        with open_session(link, connect_timeout_s=ARM_LIMIT_S) as session:
            _arm(request, robot, Observer(session))
            assert process.pid is not None
            yield process.pid
    finally:
        process.kill()
        process.join()


def _arm(request: MeasurementRequest, robot: RobotOnBus, observer: Observer) -> None:
    """Until every module says that it is armed. Looks rarely: this machine is slow, and modules and host need it."""
    deadline = time.monotonic() + ARM_LIMIT_S
    while robot.listener.states() != [ModuleState.ARMED] * JOINT_COUNT:
        if time.monotonic() > deadline:
            log = robot.read_log("host")[-300:]
            raise TrialError(f"not armed within {ARM_LIMIT_S:g} s: {observer.in_words()}; {log}")
        if observer.state() != "armed":
            observer.arm(ARM_LIMIT_S)
        robot.listener.discard_frames()
        observer.watch(LOOK_S)
    request.retry(observer.stumbles)


def _become_host(arguments: Sequence[str], folder: Path) -> None:
    """In a new process, forked from one that has imported everything: an emulated machine takes long for that."""
    os.environ["XDG_STATE_HOME"] = str(folder)
    output = os.open(folder / "host.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    sys.exit(host_process.main([*arguments, "--parent", str(os.getppid())]))


def watchdog(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """A module whose host is silent from some instant on. The value: until it is passive, in its own exact time."""
    rng = random.Random(8)
    for _ in range(request.trials):
        module: ModuleFirmware = arm_module()
        now_us = BOOTED_AT_US
        for count in range(rng.randrange(5, 40)):
            now_us += 10 * US_PER_MS
            module.handle_sync(count, RESTING_READINGS)
            module.poll(now_us)
            module.receive_setpoint(make_setpoint(count), now_us)
        assert module.state == ModuleState.ARMED, module.state
        last_us = now_us
        while module.state == ModuleState.ARMED and now_us - last_us < 1000 * US_PER_MS:
            now_us += US_PER_MS / 10
            module.poll(now_us)
        failure = "" if module.state == ModuleState.FAULT else f"it is {module.state.name}"
        yield InjectionTrial(value=(now_us - last_us) / US_PER_MS, failure=failure)


def clock_step(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """An hour ahead, then an hour back, while a robot moves at 25 Hz. The value: faults and stops."""
    scenario = write_scenario_files(
        request.folder, scenario=SCENARIO.replace('channels = ["CHANNEL"]\n', "")
    )
    settings = {
        "robot.chain.modules": JOINT_COUNT,
        "backend": request.backend,
        "duration_s": 3600.0,
    }
    config = load_scenario(
        scenario, [KeyOverride(key, value, "the fault table") for key, value in settings.items()]
    ).config
    with robot(request, config) as (started_robot, observer):
        for number in range(request.trials):
            trial = InjectionTrial(value=None)
            for _ in range(ATTEMPTS):
                trial = _stepped(started_robot, observer, STEP_S if number % 2 == 0 else -STEP_S)
                if trial.value == 0:
                    break
                request.retry()
                _step_clock(STEP_S if number % 2 else -STEP_S)
                observer.arm(START_LIMIT_S)
            yield trial
        if request.trials % 2:
            _step_clock(-STEP_S)
    request.note(
        f"{JOINT_COUNT} joints at {RATE_HZ:g} Hz, holding; the clock goes {STEP_S:g} s ahead and back by turns. A "
        "step that met a stop, as an emulated machine brings about by itself, was tried again, at most "
        f"{ATTEMPTS} times"
    )


def _stepped(started_robot: ProcessRobot, observer: Observer, by_s: float) -> InjectionTrial:
    while observer.state() != "armed":
        observer.arm(START_LIMIT_S)
    observer.watch(LIVE_S + started_robot.random.random() / RATE_HZ)
    observer.forget()
    _step_clock(by_s)
    observer.watch(AFTER_STEP_S)
    faults = len(observer.status.faults) if observer.status is not None else 1
    stops = sum(h.message.sequence is None for h in observer.applied)
    failure = "" if observer.state() == "armed" else f"stopped: {observer.in_words()}"
    if len(observer.applied) < AFTER_STEP_S * RATE_HZ / 2:
        failure = (
            failure or f"only {len(observer.applied)} setpoints received of in {AFTER_STEP_S:g} s"
        )
    return InjectionTrial(value=float(faults + stops), failure=failure)


def _step_clock(by_s: float) -> None:
    time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + by_s)
