"""Tests requests for new parameters of a running controller: valid ones take effect, others change nothing."""

import msgspec
import pytest

from snakesim_gnc.control.service.live_parameters import LiveParameters
from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.network.client import HostClient
from snakesim_hal.network.local_network import LocalNetwork, LocalSession
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Clock, ControlParameters, ParametersRequest
from snakesim_testing.hal.small_robots import make_description

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


class Bench:
    """The live parameters of the control service, and an operator who requests others."""

    def __init__(self) -> None:
        network = LocalNetwork()
        config = load_scenario("triplet", []).config
        self.parameters = LiveParameters(HostClient(network.create_session(), "control"), config)
        self.parameters.configure(make_description())
        # For each request, whether control must create its controller again.
        self.must_rebuild: list[bool] = []
        network.run_responders = lambda: self.must_rebuild.append(
            self.parameters.answer_requests(CLOCK)
        )
        self.operator: LocalSession = network.create_session()
        self.parameters.answer_requests(CLOCK)

    def request_parameters(self, parameters: str, controller: str = "obstacle_triplet") -> Answer:
        return self.operator.send_request(
            keys.PARAMETERS,
            ParametersRequest(requester="ada", controller=controller, parameters=parameters),
        )

    def read_parameters_in_force(self) -> ControlParameters:
        parameters = self.operator.wait_for_latched(
            keys.PARAMETERS_IN_FORCE, ControlParameters, 1.0
        )
        assert parameters is not None
        return parameters


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_live_parameters_valid_request_takes_effect_and_rebuilds_controller(
    bench: Bench,
):
    reported = bench.read_parameters_in_force()
    assert msgspec.json.decode(reported.parameters)["propulsion_n"] == 35.0
    assert '"propulsion_n":{"unit":"N"' in reported.schema
    assert reported.requester is None
    assert reported.changes == 0
    assert bench.request_parameters('{"propulsion_n": 20}').ok
    assert bench.must_rebuild == [True]
    reported = bench.read_parameters_in_force()
    assert msgspec.json.decode(reported.parameters)["propulsion_n"] == 20.0
    assert reported.requester == "ada"
    assert reported.changes == 1
    assert reported.tick == 7


@pytest.mark.parametrize(
    ("parameters", "expected_reason"),
    [
        (
            '{"propulsion_n": -1}',
            "`controllers.obstacle_triplet.propulsion_n` = -1 N is not allowed",
        ),
        ('{"propulsion": 1}', "did you mean `propulsion_n`?"),
        ('{"propulsion_n": NaN}', "malformed"),
        ("[]", "object"),
    ],
)
def test_live_parameters_invalid_request_is_refused_and_changes_nothing(
    bench: Bench, parameters: str, expected_reason: str
):
    before = bench.read_parameters_in_force()
    answer = bench.request_parameters(parameters)
    assert not answer.ok
    assert answer.refusal == "bad_parameters"
    assert expected_reason in answer.reason
    assert bench.must_rebuild == [False]
    assert bench.read_parameters_in_force() == before


def test_live_parameters_for_another_controller_are_refused(bench: Bench):
    answer = bench.request_parameters("{}", controller="hold")
    assert answer.refusal == "wrong_controller"
    assert "obstacle_triplet" in answer.reason
