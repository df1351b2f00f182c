"""`change`: new parameters of a controller that runs, and of one that cannot go on with them."""

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
WHY = "controller obstacle_triplet (class ObstacleTriplet): update() raised ZeroDivisionError: division by zero"


class Control:
    """The control service as far as its parameters go: it reports its state after every request."""

    def __init__(self, reported: ControlState | None, *, gone: bool = False) -> None:
        """reported: after a request; None: it is silent. gone: it publishes no parameters after it."""
        self._network = LocalNetwork()
        session = self._network.create_session()
        self._settings = LiveParameters(
            HostClient(session, "control"), load_scenario("triplet", []).config
        )
        self._settings.configure(make_description())
        self._settings.answer_requests(CLOCK)
        self._states = session.declare_publisher(keys.CONTROL_STATE, ControlState)
        self._reported = reported
        self._gone = gone
        self._network.run_responders = self._answer
        self.operator: LocalSession = self._network.create_session()

    def _answer(self) -> None:
        self._settings.answer_requests(CLOCK)
        if self._reported is not None:
            self._states.put(self._reported)
        if self._gone:
            self._network.latched.clear()


def state(reason: str, *, failed: bool = False) -> ControlState:
    return ControlState(
        tick=8,
        timestamp_ns=80,
        controller="obstacle_triplet",
        state="NotLocomoting",
        reason=reason,
        failed=failed,
    )


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MAX_SILENCE_S", "REPORT_TIMEOUT_S"):
        monkeypatch.setattr(parameters, name, 0.05)


@pytest.mark.parametrize(
    "reported", [state("standing still"), None], ids=["goes on", "time stands"]
)
def test_what_a_controller_goes_on_with_is_returned(reported: ControlState | None) -> None:
    before, now = parameters.change_parameters(Control(reported).operator, CHANGES, "ada")
    assert before.changes == 0
    assert now.changes == 1
    assert now.requester == "ada"


@pytest.mark.parametrize("gone", [False, True])
def test_a_value_that_ends_control_is_named_with_the_reason(gone: bool) -> None:
    control = Control(state(WHY, failed=True), gone=gone)
    with raises_error(
        ControllerError, code="controller/failed", field=("control.propulsion_n", WHY)
    ):
        parameters.change_parameters(control.operator, CHANGES, "ada")


def test_settings_that_vanish_without_a_reason_are_not_confirmed() -> None:
    with raises_error(RefusedError, code="robot/not-confirmed"):
        parameters.change_parameters(Control(None, gone=True).operator, CHANGES, "ada")
