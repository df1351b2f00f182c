"""Faults on request: their texts, and what each does to a chain."""

import pytest

from snakesim_can_backend.protocol.definitions import Action, ModuleState, Opcode, node_of, opcode_of
from snakesim_can_backend.twin.faults import ABOUT, explain, parse, parse_typed, typed
from snakesim_hal.errors import ConfigError
from snakesim_hal.injection import KINDS, Injection
from tests.unit.can_backend.twin.rig import Host, chain, command, only


def host(*faults: str) -> Host:
    made = Host(chain(faults=list(faults)))
    made.arm()
    return made


def of_node_2(frames, opcode=Opcode.JOINT_STATE):
    return [f for f in frames if node_of(f.id) == 2 and opcode_of(f.id) == opcode]


def test_texts_go_both_ways():
    assert parse("mute:joint_3@2.0", 4) == Injection("mute", "joint_3", 2.0)
    for text in ("leak:joint_1@1-4", "babble:joint_4@0.5"):
        assert str(parse(text, 4)) == text
    assert parse_typed("mute joint_2\n", 4, 7.0) == (Injection("mute", "joint_2", 7.0), True)
    assert parse_typed("mute joint_2 off", 4, 7.0) == (Injection("mute", "joint_2", 7.0), False)
    for begins in (True, False):
        fault = Injection("leak", "joint_4", 3.0)
        assert parse_typed(typed(fault, begins=begins), 4, 3.0) == (fault, begins)
    assert all(kind in explain() for kind in ABOUT)


def test_every_fault_of_a_joint_is_known_but_those_that_a_module_cannot_have():
    assert KINDS["joint"].keys() - ABOUT.keys() == {"wrong", "nan"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mute", "KIND:TARGET@START"),
        ("mute:joint_3", "KIND:TARGET@START"),
        ("mote:joint_3@2", "knows no 'mote', only mute, freeze"),
        ("mute:joint_5@2", "no joint_5; this run has joint_1 to joint_4"),
        ("mute:joint_1@2-1", "must be later than its start"),
        ("mute:joint_1@1.2.3", "are numbers"),
        ("wrong:joint_1@1", "modules support mute, freeze, reboot"),
        ("kill:control@1", "modules support mute, freeze, reboot"),
    ],
)
def test_wrong_texts_are_told_what_is_allowed(text: str, message: str):
    with pytest.raises(ConfigError, match=message.replace("(", r"\(")):
        parse(text, 4)


def test_mute_says_nothing_and_comes_back():
    run = host("mute:joint_2@0.05-0.1")
    counts = [len(of_node_2(run.tick(0.1))) for _ in range(20)]
    assert counts[:3] == [1, 1, 1] and counts[5:8] == [0, 0, 0] and counts[-1] == 1
    assert run.states()[1] == ModuleState.ARMED, "it hears and follows meanwhile"


def test_a_frozen_module_repeats_itself_and_ends_passive():
    run = host("freeze:joint_2@0.05")
    answers = [of_node_2(run.tick(0.1)) for _ in range(30)]
    assert len({a[0].data for a in answers[6:]}) == 1 and all(len(a) == 1 for a in answers)
    assert run.chain.slots[1].module.demand.mode == 0


def test_a_duplicate_answers_with_another_serial():
    run = host("duplicate:joint_2@0.05-0.2")
    frames = run.ticks(8, 0.1)
    assert len(of_node_2(frames)) == 2
    run.chain.receive(0, command(Action.IDENTIFY))
    serials = [i["serial"] for i in only(run.chain.take(0), Opcode.IDENTITY)]
    assert len(serials) == len(set(serials)) == 5
    frames = run.ticks(20, 0.1)
    assert len(of_node_2(frames)) == 1


@pytest.mark.parametrize("kind", ["overheat", "leak", "undervoltage"])
def test_a_module_that_finds_something_wrong_inside_gives_up(kind: str):
    run = host(f"{kind}:joint_2@0.05-0.1")
    for _ in range(20):
        run.tick(0.1)
    assert run.states() == [2, 4, 2, 2]
    for _ in range(4000 if kind == "overheat" else 1):
        run.tick()
    run.chain.receive(0, command(Action.CLEAR))
    assert run.states()[1] == ModuleState.DISARMED


def test_a_babbler_floods_the_bus():
    run = host("babble:joint_2@0.05")
    frames = run.ticks(8, 0.1)
    assert 60 < len(of_node_2(frames, Opcode.HEARTBEAT)) < 80
