"""A real router with mTLS passes exactly the messages that the access table grants.

The tests try every combination of role, key and kind of message. The router's log must name each refused combination
with the common name of the certificate.

The witness has the certificate of a router. The router passes everything that the witness sends and requests, so that
only the rules of the session under test decide.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import zenoh

from snakesim_hal.wire.roles import ACCESS_RULES, OWN_NAME_ONLY, Role
from snakesim_testing.lab.router_waits import LIMIT_S, eventually, settle
from snakesim_testing.lab.small_lab import OTHER_ROBOT, OWN_ROBOT, RunningLab

# Maps the key of each rule to one example. `control` is a service of the role gnc, `hal` is not.
EXAMPLE_KEYS = {rule.key: rule.key.replace("*", "control") for rule in ACCESS_RULES} | {
    "process/*": "process/control-1a2b"
}
FORGED_KEYS = {  # keys with the name of another service, and the key of the rule that covers them
    "alive/hal": "alive/*",
    "hal/done/hal": "hal/done/*",
    "fault/run": "fault/*",
    "process/host-1a2b": "process/*",
    "sensor/unknown": None,
}
ALL_KEYS = (*EXAMPLE_KEYS.values(), *FORGED_KEYS)
KINDS = ("publish", "delete", "read", "ask", "answer", "declare", "watch")
WITNESS_PAYLOAD = "from the witness"
LOGGED_REFUSALS = {  # texts in the router's log, by the kind of message
    "publish": ("Put (ingress)",),
    "delete": ("Delete (ingress)",),
    "read": ("Put (egress)", "Declare Subscriber (ingress)"),
    "ask": ("Query (ingress)",),
    "answer": ("Declare Queryable (ingress)",),
    "declare": ("Liveliness Token (ingress)",),
    "watch": ("Liveliness Query (ingress)",),
}

KeysByKind = dict[str, set[str]]  # by the kind of message: the keys at which messages passed


@pytest.fixture(scope="module")
def witness(lab: RunningLab) -> Iterator[zenoh.Session]:
    """Open a session with the certificate of a router."""
    with lab.open_session(lab.find_identity_by_name("router.spare.hub")) as session:
        yield session


def list_granted_keys(role: Role, robot: str) -> KeysByKind:
    """Return the keys that the access table grants to a role of a robot.

    A gnc may write only below the names of its own services. A recorder has no service.
    """
    granted: KeysByKind = {kind: set() for kind in KINDS}
    if robot != OWN_ROBOT:
        return granted
    for rule in ACCESS_RULES:
        forged_keys = {key for key, rule_key in FORGED_KEYS.items() if rule_key == rule.key}
        for kind in rule.list_actions(role):
            needs_own_name = "*" in rule.key and kind in OWN_NAME_ONLY
            if needs_own_name and role is Role.RECORDER:
                continue
            granted[kind].add(EXAMPLE_KEYS[rule.key])
            if not (needs_own_name and role is Role.GNC):
                granted[kind] |= forged_keys
    return granted


QUICK_CASES = [*((role, OWN_ROBOT) for role in Role), (Role.GNC, OTHER_ROBOT)]
SLOW_CASES = [
    pytest.param(role, OTHER_ROBOT, marks=pytest.mark.slow) for role in Role if role is not Role.GNC
]


@pytest.mark.parametrize(("role", "robot"), [*QUICK_CASES, *SLOW_CASES])
def test_router_passes_exactly_what_access_table_grants(
    lab: RunningLab, witness: zenoh.Session, role: Role, robot: str
) -> None:
    """The certificate is one of `robot`; all keys are those of OWN_ROBOT."""
    identity = lab.find_identity_by_role(role, robot)
    with lab.open_session(identity) as session:
        passed = find_passed_samples(session, witness) | find_passed_queries(session, witness)
    granted = list_granted_keys(role, robot)
    assert passed == granted, identity.common_name
    refused = {kind: set(ALL_KEYS) - keys for kind, keys in granted.items()}
    eventually(lambda: read_logged_refusals(lab, identity.common_name), refused)


def read_logged_refusals(lab: RunningLab, name: str) -> KeysByKind:
    """Return which of ALL_KEYS the router's log lists as refused to a certificate."""
    refusals = [line.partition(f" refused: {name}: ")[2] for line in lab.read_router_log()]
    refused: KeysByKind = {}
    for kind, texts in LOGGED_REFUSALS.items():
        prefixes = [f"{text} on {OWN_ROBOT}/" for text in texts]
        keys = {
            refusal.removeprefix(prefix)
            for prefix in prefixes
            for refusal in refusals
            if refusal.startswith(prefix)
        }
        refused[kind] = keys & set(ALL_KEYS)  # The log also has keys of other tests.
    return refused


@pytest.mark.parametrize("role", [Role.VIEWER, Role.OPERATOR, Role.GNC])
def test_wildcard_key_without_right_does_not_pass(
    lab: RunningLab, witness: zenoh.Session, role: Role
) -> None:
    """A put at `actuator/*` does not pass if a put at `actuator/joints` may not; the same holds for queries."""
    wildcard_keys = [
        f"{robot}/{key}"
        for robot in (OWN_ROBOT, "*")
        for key in ("actuator/*", "hal/*", "**", "sensor/*", "fault/**")
    ]
    passed: set[str] = set()
    with lab.open_session(lab.find_identity_by_role(role, OWN_ROBOT)) as session:
        subscriber = witness.declare_subscriber(
            "**", lambda sample: passed.add(f"put {sample.key_expr}")
        )
        queryable = witness.declare_queryable(
            "**", lambda query: passed.add(f"query {query.key_expr}")
        )
        settle(session, witness)
        for key in wildcard_keys:
            session.put(key, "x")
            session.get(key, timeout=LIMIT_S)  # a query that expires before it is sent is not sent
        settle(session, witness)
        queryable.undeclare()
        subscriber.undeclare()
    assert not passed


def test_wildcard_stop_reaches_only_robots_of_the_certificate(lab: RunningLab) -> None:
    """`snakesim estop` without a name stops every robot that the certificate covers, and no other robot."""
    stopped: list[str] = []
    tokens: list[zenoh.LivelinessToken] = []  # A token ends when its last reference is deleted.
    with ExitStack() as stack:
        for robot in (OWN_ROBOT, OTHER_ROBOT):
            session = stack.enter_context(
                lab.open_session(lab.find_identity_by_role(Role.ROBOT, robot))
            )
            session.declare_queryable(
                f"{robot}/hal/estop", lambda query, robot=robot: stopped.append(robot)
            )
            tokens.append(session.liveliness().declare_token(f"{robot}/alive/hal"))
        operator_of_all = stack.enter_context(
            lab.open_session(lab.find_identity_by_name("operator.all.laptop"))
        )
        operator_of_one = stack.enter_context(
            lab.open_session(lab.find_identity_by_role(Role.OPERATOR, OTHER_ROBOT))
        )
        settle(operator_of_all)
        for session, robots in (
            (operator_of_one, []),
            (operator_of_all, [OTHER_ROBOT, OWN_ROBOT]),
        ):
            stopped.clear()
            session.get("**/hal/estop", target=zenoh.QueryTarget.ALL, timeout=LIMIT_S)
            settle(operator_of_all)
            assert sorted(stopped) == sorted(robots)
        alive_keys = {
            str(reply.ok.key_expr)
            for reply in operator_of_all.liveliness().get("**/alive/hal")
            if reply.ok is not None
        }
        assert alive_keys == {f"{OWN_ROBOT}/alive/hal", f"{OTHER_ROBOT}/alive/hal"}


def test_router_state_is_readable_by_administrator_and_never_writable(lab: RunningLab) -> None:
    """The admin space of Zenoh contains every session and address, so that only an administrator may read it."""
    for role in Role:
        with lab.open_session(lab.find_identity_by_role(role, OWN_ROBOT)) as session:
            replies = [
                reply for reply in session.get("@/*/router", timeout=0.5) if reply.ok is not None
            ]
            assert bool(replies) == (role is Role.ADMINISTRATOR), role
            session.put("@/*/router/config/access_control/enabled", "false")


def find_passed_samples(session: zenoh.Session, witness: zenoh.Session) -> KeysByKind:
    """Return the keys at which the session publishes, deletes and reads with success."""
    passed: KeysByKind = {"publish": set(), "delete": set(), "read": set()}

    def record_at_witness(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            passed["delete"].add(remove_namespace(sample.key_expr))
        elif sample.payload.to_string() != WITNESS_PAYLOAD:
            passed["publish"].add(remove_namespace(sample.key_expr))

    def record_at_session(sample: zenoh.Sample) -> None:
        if sample.payload.to_string() == WITNESS_PAYLOAD:
            passed["read"].add(remove_namespace(sample.key_expr))

    subscribers = [witness.declare_subscriber(f"{OWN_ROBOT}/**", record_at_witness)]
    subscribers += [
        session.declare_subscriber(f"{OWN_ROBOT}/{key}", record_at_session) for key in ALL_KEYS
    ]
    settle(session, witness)
    # By default Zenoh drops a message if its queue remains full for 0.1 ms.
    block_when_full = zenoh.CongestionControl.BLOCK
    for key in ALL_KEYS:
        witness.put(f"{OWN_ROBOT}/{key}", WITNESS_PAYLOAD, congestion_control=block_when_full)
        session.put(f"{OWN_ROBOT}/{key}", "from the session", congestion_control=block_when_full)
        session.delete(f"{OWN_ROBOT}/{key}", congestion_control=block_when_full)
    settle(session, witness)
    for subscriber in subscribers:
        subscriber.undeclare()
    return passed


def find_passed_queries(session: zenoh.Session, witness: zenoh.Session) -> KeysByKind:
    """Return the keys at which queries and liveliness tokens pass, in both directions."""
    session_tokens = session.liveliness()
    witness_tokens = witness.liveliness()
    return {
        "ask": find_answered_keys(
            session, witness, lambda key: session.get(key, timeout=1.0), witness.declare_queryable
        ),
        "answer": find_answered_keys(
            session, witness, lambda key: witness.get(key, timeout=1.0), session.declare_queryable
        ),
        "watch": find_answered_keys(
            session, witness, session_tokens.get, lambda key, _: witness_tokens.declare_token(key)
        ),
        "declare": find_answered_keys(
            session, witness, witness_tokens.get, lambda key, _: session_tokens.declare_token(key)
        ),
    }


def find_answered_keys(
    session: zenoh.Session,
    witness: zenoh.Session,
    get: Callable[..., Iterator[zenoh.Reply]],
    declare: Callable[..., Any],
) -> set[str]:
    """Return the keys at which `get` finds what `declare` declared on the other side."""
    declarations = [declare(f"{OWN_ROBOT}/{key}", answer_query) for key in ALL_KEYS]
    settle(session, witness)
    replies = {key: get(f"{OWN_ROBOT}/{key}") for key in ALL_KEYS}
    answered = {
        key for key, channel in replies.items() if any(reply.ok is not None for reply in channel)
    }
    for declaration in declarations:
        declaration.undeclare()
    settle(session, witness)
    return answered


def answer_query(query: zenoh.Query) -> None:
    query.reply(query.key_expr, "an answer")
    query.drop()


def remove_namespace(key: object) -> str:
    return str(key).removeprefix(f"{OWN_ROBOT}/")
