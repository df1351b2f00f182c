"""Changes parameters of a controller that continues with them, and of one that fails."""

import pytest

from snakesim_gnc.control.service.live_parameters import LiveParameters
from snakesim_hal.base.errors import ControllerError, RefusedError
from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.network.client import HostClient
from snakesim_hal.network.local_network import LocalNetwork, LocalSession
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, ControlState
from snakesim_operator.robot_commands import parameters
from snakesim_testing.hal.small_robots import make_description
from snakesim_testing.messages import raises_error

CLOCK = Clock(
    tick=7,
    timestamp_ns=70,
    period_ns=10,
    clock_mode="lockstep",
    lifecycle="armed",
    arm_session=1,
    lease_epoch=1,
    newest={},
)
CHANGES = {"control.propulsion_n": 20}
FAILURE = "controller obstacle_triplet (class ObstacleTriplet): update() raised ZeroDivisionError: division by zero"


class ParameterService:
    """The part of the control service that changes parameters; it answers whenever the network runs."""

    def __init__(
        self, reported_state: ControlState | None, *, removes_parameters: bool = False
    ) -> None:
        """Start the service.

        Args:
            reported_state: the state that it publishes after a request; None: it publishes none.
            removes_parameters: whether it stops publishing parameters after a request.
        """
        self._network = LocalNetwork()
        session = self._network.create_session()
        self._parameters = LiveParameters(
            HostClient(session, "control"), load_scenario("triplet", []).config
        )
        self._parameters.configure(make_description())
        self._parameters.answer_requests(CLOCK)
        self._state_publisher = session.declare_publisher(keys.CONTROL_STATE, ControlState)
        self._reported_state = reported_state
        self._removes_parameters = removes_parameters
        self._network.run_responders = self._answer
        self.operator: LocalSession = self._network.create_session()

    def _answer(self) -> None:
        """Answer the requests, and publish what the constructor requires."""
        self._parameters.answer_requests(CLOCK)
        if self._reported_state is not None:
            self._state_publisher.put(self._reported_state)
        if self._removes_parameters:
            self._network.latched.clear()


def make_state(reason: str, *, failed: bool = False) -> ControlState:
    """Make the state of a controller that does not locomote."""
    return ControlState(
        tick=8,
        timestamp_ns=80,
        controller="obstacle_triplet",
        state="NotLocomoting",
        reason=reason,
        failed=failed,
    )


@pytest.fixture(autouse=True)
def short_timeouts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the timeouts of a change, because some of these tests wait for them."""
    for name in ("MAX_SILENCE_S", "REPORT_TIMEOUT_S"):
        monkeypatch.setattr(parameters, name, 0.05)


@pytest.mark.parametrize(
    "reported_state", [make_state("standing still"), None], ids=["running", "paused"]
)
def test_parameter_change_of_running_or_paused_controller_is_returned(
    reported_state: ControlState | None,
) -> None:
    service = ParameterService(reported_state)
    before, after = parameters.change_parameters(service.operator, CHANGES, "ada")
    assert before.changes == 0
    assert after.changes == 1
    assert after.requester == "ada"


@pytest.mark.parametrize("removes_parameters", [False, True])
def test_parameter_change_that_ends_control_names_value_and_reason(
    removes_parameters: bool,
) -> None:
    service = ParameterService(
        make_state(FAILURE, failed=True), removes_parameters=removes_parameters
    )
    with raises_error(
        ControllerError, code="controller/failed", field=("control.propulsion_n", FAILURE)
    ):
        parameters.change_parameters(service.operator, CHANGES, "ada")


def test_parameter_change_without_state_and_parameters_is_not_confirmed() -> None:
    service = ParameterService(None, removes_parameters=True)
    with raises_error(RefusedError, code="robot/not-confirmed"):
        parameters.change_parameters(service.operator, CHANGES, "ada")
