"""Measures a robot while the wall clock of its machine is set. This needs a virtual machine."""

import time
from collections.abc import Iterator

from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario
from snakesim_testing.can.listened_bus import JOINT_COUNT, RATE_HZ, SCENARIO
from snakesim_testing.hal.small_robots import write_scenario_files
from verification.faults.observer import Observer
from verification.faults.robot import START_TIMEOUT_S, ProcessRobot, start_robot
from verification.faults.row import InjectionTrial, MeasurementRequest

MOVING_S = 0.3  # from arming to the step of the clock
STEP_S = 3600.0
OBSERVED_S = 1.0  # after the step
MAX_ATTEMPTS = 3  # of one step


def measure_clock_step(request: MeasurementRequest) -> Iterator[InjectionTrial]:
    """Set the wall clock an hour ahead and back, in turn, while a robot moves.

    Yields:
        Trials whose value is the number of faults and stops.
    """
    with start_robot(request, _make_small_config(request)) as (robot, observer):
        for number in range(request.trials):
            step_s = STEP_S if number % 2 == 0 else -STEP_S
            trial = InjectionTrial(value=None)
            for _ in range(MAX_ATTEMPTS):
                trial = _run_clock_step_trial(robot, observer, step_s)
                if trial.value == 0:
                    break
                request.count_retries()
                _step_wall_clock(-step_s)
                observer.arm(START_TIMEOUT_S)
            yield trial
        if request.trials % 2:
            _step_wall_clock(-STEP_S)
    request.add_note(
        f"{JOINT_COUNT} joints at {RATE_HZ:g} Hz, holding; the clock goes {STEP_S:g} s ahead and back in turn. A step "
        f"during which the robot stopped was repeated, at most {MAX_ATTEMPTS} times: an emulated machine causes stops "
        "by itself"
    )


def _make_small_config(request: MeasurementRequest) -> RunConfig:
    """Return the configuration of a robot with few joints, which an emulated machine can run in real time."""
    scenario = write_scenario_files(
        request.folder, scenario=SCENARIO.replace('channels = ["CHANNEL"]\n', "")
    )
    values = {"robot.chain.modules": JOINT_COUNT, "backend": request.backend, "duration_s": 3600.0}
    overrides = [KeyOverride(key, value, "the fault table") for key, value in values.items()]
    return load_scenario(scenario, overrides).config


def _run_clock_step_trial(robot: ProcessRobot, observer: Observer, step_s: float) -> InjectionTrial:
    """Set the wall clock once at a random phase of a period, and count the faults and stops that follow."""
    while observer.get_lifecycle() != "armed":
        observer.arm(START_TIMEOUT_S)
    observer.listen_for(MOVING_S + robot.random.random() / RATE_HZ)
    observer.forget()
    _step_wall_clock(step_s)
    observer.listen_for(OBSERVED_S)
    fault_count = len(observer.status.faults) if observer.status is not None else 1
    stop_count = sum(received.message.sequence is None for received in observer.applied)
    setpoint_count = len(observer.applied)
    failure = ""
    if observer.get_lifecycle() != "armed":
        failure = f"stopped: {observer.describe_status()}"
    elif setpoint_count < OBSERVED_S * RATE_HZ / 2:
        failure = f"only {setpoint_count} setpoints received in {OBSERVED_S:g} s"
    return InjectionTrial(value=float(fault_count + stop_count), failure=failure)


def _step_wall_clock(step_s: float) -> None:
    """Set the wall clock of this machine ahead, or back by a negative step."""
    time.clock_settime(time.CLOCK_REALTIME, time.clock_gettime(time.CLOCK_REALTIME) + step_s)
