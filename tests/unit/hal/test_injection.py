"""Injected faults: their texts, the process that executes each, and their order in time."""

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from docs.site.kinds_table import PAGE, make_page
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import (
    FAULT_KINDS,
    FaultInjection,
    FaultTransition,
    InjectionPlan,
    describe_fault_kinds,
    parse_injection,
    summarize_fault_kinds,
    validate_and_complete_injection,
    validate_injection_targets,
)
from snakesim_hal.model.fault_plan import (
    parse_and_validate_planned_faults,
    parse_planned_faults,
    validate_faults_for_backend,
    validate_faults_without_supervisor,
)
from snakesim_hal.wire import keys
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

TARGETS = {
    "process": ["control", "host"],
    "key": [keys.JOINT_COMMAND, keys.JOINTS, keys.done_key("guidance")],
    "joint": ["joint_1", "joint_13"],
    "bus": ["bus_1"],
    "simulator": ["simulator"],
    "clock": ["clock"],
}
times_s = st.floats(0.0, 1e4).map(lambda s: round(s, 2))


@st.composite
def draw_injection(draw: st.DrawFn) -> FaultInjection:
    """Draw any valid fault injection."""
    target_type = draw(st.sampled_from(sorted(FAULT_KINDS)))
    name = draw(st.sampled_from(sorted(FAULT_KINDS[target_type])))
    start_s = draw(times_s)
    end_s = draw(st.one_of(st.just(inf), times_s.map(lambda s: round(start_s + s + 0.01, 2))))
    amount = FAULT_KINDS[target_type][name].amount
    drawn_amount = (
        None
        if amount is None
        else draw(st.sampled_from([amount.min_value, amount.default, amount.max_value]))
    )
    return FaultInjection(
        name, draw(st.sampled_from(TARGETS[target_type])), start_s, end_s, drawn_amount
    )


@given(draw_injection())
def test_injection_text_is_parsed_and_formatted(injection: FaultInjection) -> None:
    parsed = parse_injection(str(injection))
    assert str(parsed) == str(injection)
    assert parsed.kind == injection.kind
    assert parsed.target == injection.target
    assert parsed.executing_part == injection.executing_part
    assert parsed.kind_info is FAULT_KINDS[parsed.target_type][parsed.kind]


def test_injection_without_amount_has_the_default() -> None:
    assert parse_injection("drop:sensor/joints@1").amount == 1.0
    assert parse_injection("delay:sensor/joints@1").amount == 0.05
    assert parse_injection("mute:joint_2@1").amount is None


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("kill:control@1", "run"),
        ("freeze:host@1", "run"),
        ("hang:control@1", "control"),
        ("hang:host@1", "hal"),
        ("step:clock@1", "run"),
        ("mute:joint_1@1", "hal"),
        ("cut:bus_1@1", "hal"),
        ("slow:simulator@1", "hal"),
        ("drop:actuator/joints@1", "control"),
        ("drop:sensor/joints@1", "hal"),
        ("delay:hal/status@1", "hal"),
        ("drop:guidance/world@1", "guidance"),
        ("drop:hal/done/navigation@1", "navigation"),
    ],
)
def test_injection_names_the_part_that_executes_it(text: str, part: str) -> None:
    assert parse_injection(text).executing_part == part


def test_injection_into_a_missing_target_is_refused() -> None:
    validate_injection_targets(
        [parse_injection("mute:joint_13@1"), parse_injection("kill:host@1")],
        services=["control"],
        joint_count=13,
        bus_count=0,
    )
    with raises_error(ConfigError, code="injection/unknown-target"):
        validate_injection_targets(
            [parse_injection("drop:guidance/world@1")],
            services=["control"],
            joint_count=13,
            bus_count=0,
        )


def test_injection_request_is_checked_like_a_text() -> None:
    assert validate_and_complete_injection(FaultInjection("drop", keys.JOINTS)).amount == 1.0
    with raises_error(ConfigError, code="injection/unknown-fault"):
        validate_and_complete_injection(FaultInjection("mute", "control"), "mute control")


@given(st.lists(draw_injection(), max_size=8), st.lists(times_s, max_size=8))
def test_injection_plan_yields_each_change_once_in_time_order(
    planned: list[FaultInjection], poll_times_s: list[float]
) -> None:
    plan = InjectionPlan(planned)
    changes: list[FaultTransition] = []
    for now_s in [*sorted(poll_times_s), inf]:
        due = plan.pop_due_transitions(now_s)
        assert (
            all(change.time_s <= now_s for change in due) and plan.next_transition_s() > now_s
        ) or now_s == inf
        changes += due
    assert [change.time_s for change in changes] == sorted(change.time_s for change in changes)
    ends = [
        planned_fault
        for planned_fault in planned
        if planned_fault.end_s != inf and not planned_fault.kind_info.is_instantaneous
    ]
    assert sorted(str(change.injection) for change in changes if change.is_start) == sorted(
        map(str, planned)
    )
    assert sorted(str(change.injection) for change in changes if not change.is_start) == sorted(
        map(str, ends)
    )
    assert plan.next_transition_s() == inf


def test_injection_help_explains_every_kind() -> None:
    for kinds in FAULT_KINDS.values():
        for name, kind in kinds.items():
            assert name in summarize_fault_kinds()
            assert name in describe_fault_kinds()
            assert kind.description in describe_fault_kinds()


def test_injection_page_has_every_kind() -> None:
    assert PAGE.read_text(encoding="utf-8") == make_page(), (
        "run `make schemas` and commit what it changes"
    )


# --- planned faults of a run -----------------------------------------------------------------------------------


def test_injection_plan_with_invalid_entry_is_refused_by_entry() -> None:
    assert [
        str(planned_fault)
        for planned_fault in parse_planned_faults(make_run_config(faults=["mute:joint_1@1"]))
    ] == ["mute:joint_1@1"]
    with raises_error(ConfigError, code="injection/unknown-fault", field="crawl"):
        parse_planned_faults(make_run_config(faults=["mute:joint_1@1", "mute"]))
    with raises_error(ConfigError, code="injection/unknown-target", field="faults[0]"):
        parse_and_validate_planned_faults(make_run_config(faults=["mute:joint_4@1"]))
    parse_and_validate_planned_faults(
        make_run_config(faults=["cut:bus_8@1", "hang:control@1", "leak:joint_3@1"])
    )


def test_injection_that_a_backend_does_not_support_is_refused() -> None:
    backend = {"supported_kinds": ("leak",), "bus_count": 1, "reason": "it is a toy"}
    validate_faults_for_backend(
        make_run_config(faults=["leak:joint_1@1", "mute:joint_1@1", "slow:simulator@1"]), **backend
    )
    with raises_error(ConfigError, code="injection/not-supported", field="faults[1]"):
        validate_faults_for_backend(
            make_run_config(faults=["leak:joint_1@1", "reboot:joint_1@1"]), **backend
        )
    with raises_error(ConfigError, code="injection/unknown-target", field="bus_2"):
        validate_faults_for_backend(make_run_config(faults=["cut:bus_2@1"]), **backend)


def test_injection_by_host_alone_refuses_killing_processes() -> None:
    validate_faults_without_supervisor(make_run_config(faults=["hang:control@1", "mute:joint_2@1"]))
    with raises_error(ConfigError, code="injection/not-supported"):
        validate_faults_without_supervisor(
            make_run_config(faults=["mute:joint_2@1", "kill:control@1"])
        )
