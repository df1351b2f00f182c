"""Every role x key x kind of message, at a real router with mTLS: what the table grants passes, and nothing else.

What does not pass is in the router's log, with the name in the certificate.

The witness holds a router's certificate: everything that the router lets pass reaches it, and whatever it sends passes
on its side, so that only the rules of the other side decide.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import zenoh

from snakesim_hal.wire.roles import ACCESS_RULES, OWN_NAME_ONLY, Role
from snakesim_testing.lab.router_waits import eventually, settle
from snakesim_testing.lab.small_lab import OTHER_ROBOT, OWN_ROBOT, RunningLab

# One key of each line; a gnc has only its own services' names, and `hal` is none of them.
KEYS = {line.key: line.key.replace("*", "control") for line in ACCESS_RULES} | {
    "process/*": "process/control-1a2b"
}
FORGED_PLACES = {
    "alive/hal": "alive/*",
    "hal/done/hal": "hal/done/*",
    "fault/run": "fault/*",
    "process/host-1a2b": "process/*",
    "sensor/unknown": None,
}
PLACES = (*KEYS.values(), *FORGED_PLACES)
KINDS = ("publish", "delete", "read", "ask", "answer", "declare", "watch")
TO_ALL = "from the witness"
REFUSED = {  # in the words of the router's log
    "publish": ("Put (ingress)",),
    "delete": ("Delete (ingress)",),
    "read": ("Put (egress)", "Declare Subscriber (ingress)"),
    "ask": ("Query (ingress)",),
    "answer": ("Declare Queryable (ingress)",),
    "declare": ("Liveliness Token (ingress)",),
    "watch": ("Liveliness Query (ingress)",),
}

Seen = dict[str, set[str]]  # by kind: the keys at which it passed


@pytest.fixture(scope="module")
def witness(lab: RunningLab) -> Iterator[zenoh.Session]:
    with lab.open_session(lab.find_identity_by_name("router.spare.hub")) as session:
        yield session


def expected(role: Role, robot: str) -> Seen:
    """What the published table says. Under a name that is not its service's, a gnc may not write."""
    granted: Seen = {kind: set() for kind in KINDS}
    for line in ACCESS_RULES if robot == OWN_ROBOT else ():
        forged = {name for name, key in FORGED_PLACES.items() if key == line.key}
        for act in line.list_actions(role):
            own_name = "*" in line.key and act in OWN_NAME_ONLY
            if not (own_name and role is Role.RECORDER):
                granted[act] |= {KEYS[line.key]} | (
                    set() if own_name and role is Role.GNC else forged
                )
    return granted


QUICK = [*((role, OWN_ROBOT) for role in Role), (Role.GNC, OTHER_ROBOT)]
SLOW = [
    pytest.param(role, OTHER_ROBOT, marks=pytest.mark.slow) for role in Role if role is not Role.GNC
]


@pytest.mark.parametrize(("role", "robot"), [*QUICK, *SLOW])
def test_what_the_table_grants_passes_and_nothing_else(
    lab: RunningLab, witness: zenoh.Session, role: Role, robot: str
) -> None:
    """robot: whose certificate it is; all keys are those of `planar13`."""
    who = lab.find_identity_by_role(role, robot)
    with lab.open_session(who) as session:
        seen = samples(session, witness) | queries(session, witness)
    granted = expected(role, robot)
    assert seen == granted, who.common_name
    refused = {kind: set(PLACES) - keys for kind, keys in granted.items()}
    eventually(lambda: seen_by(lab, who.common_name), refused)


def seen_by(lab: RunningLab, name: str) -> Seen:
    """What of these places the router's log says that it refused to a certificate."""
    said = [line.partition(f" refused: {name}: ")[2] for line in lab.read_router_log()]
    return {
        kind: {
            line.removeprefix(start)
            for words in all_words
            for line in said
            if line.startswith(start := f"{words} on {OWN_ROBOT}/")
        }
        & set(PLACES)  # other tests have asked for more
        for kind, all_words in REFUSED.items()
    }


@pytest.mark.parametrize("role", [Role.VIEWER, Role.OPERATOR, Role.GNC])
def test_a_wildcard_covers_no_more_than_its_keys(
    lab: RunningLab, witness: zenoh.Session, role: Role
) -> None:
    """Neither a put at `actuator/*` passes for who may not put at `actuator/joints`, nor a query at `hal/*`."""
    wide = [
        f"{start}/{rest}"
        for start in (OWN_ROBOT, "*")
        for rest in ("actuator/*", "hal/*", "**", "sensor/*", "fault/**")
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
        for key in wide:
            session.put(key, "x")
            session.get(key, timeout=0.2)
        settle(session, witness)
        queryable.undeclare()
        subscriber.undeclare()
    assert not passed


def test_who_has_all_robots_addresses_them_at_once(lab: RunningLab) -> None:
    """`snakesim estop` without a name stops every robot; whoever has one robot does not reach the others so."""
    stopped: list[str] = []
    tokens: list[zenoh.LivelinessToken] = []  # each lasts as long as somebody has it
    with ExitStack() as held:
        for robot in (OWN_ROBOT, OTHER_ROBOT):
            session = held.enter_context(
                lab.open_session(lab.find_identity_by_role(Role.ROBOT, robot))
            )
            session.declare_queryable(
                f"{robot}/hal/estop", lambda query, robot=robot: stopped.append(robot)
            )
            tokens.append(session.liveliness().declare_token(f"{robot}/alive/hal"))
        anyone = held.enter_context(
            lab.open_session(lab.find_identity_by_name("operator.all.laptop"))
        )
        one = held.enter_context(
            lab.open_session(lab.find_identity_by_role(Role.OPERATOR, OTHER_ROBOT))
        )
        settle(anyone)
        for session, reached in ((one, []), (anyone, [OTHER_ROBOT, OWN_ROBOT])):
            stopped.clear()
            session.get("**/hal/estop", target=zenoh.QueryTarget.ALL, timeout=0.5)
            settle(anyone)
            assert sorted(stopped) == sorted(reached)
        found = {
            str(reply.ok.key_expr)
            for reply in anyone.liveliness().get("**/alive/hal")
            if reply.ok is not None
        }
        assert found == {f"{OWN_ROBOT}/alive/hal", f"{OTHER_ROBOT}/alive/hal"}


def test_router_state_is_read_by_administrator_and_changed_by_nobody(lab: RunningLab) -> None:
    """The admin space of Zenoh names every session and address."""
    for role in Role:
        with lab.open_session(lab.find_identity_by_role(role, OWN_ROBOT)) as session:
            replies = [
                reply for reply in session.get("@/*/router", timeout=0.5) if reply.ok is not None
            ]
            assert bool(replies) == (role is Role.ADMINISTRATOR), role
            session.put("@/*/router/config/access_control/enabled", "false")


def samples(session: zenoh.Session, witness: zenoh.Session) -> Seen:
    """Put and delete of one, put of the other, at every key."""
    seen: Seen = {"publish": set(), "delete": set(), "read": set()}

    def at_witness(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            seen["delete"].add(relative(sample.key_expr))
        elif sample.payload.to_string() != TO_ALL:
            seen["publish"].add(relative(sample.key_expr))

    def at_session(sample: zenoh.Sample) -> None:
        if sample.payload.to_string() == TO_ALL:
            seen["read"].add(relative(sample.key_expr))

    subscribers = [witness.declare_subscriber(f"{OWN_ROBOT}/**", at_witness)]
    subscribers += [
        session.declare_subscriber(f"{OWN_ROBOT}/{place}", at_session) for place in PLACES
    ]
    settle(session, witness)
    # By default Zenoh drops what finds its queue full for 0.1 ms.
    wait = zenoh.CongestionControl.BLOCK
    for place in PLACES:
        witness.put(f"{OWN_ROBOT}/{place}", TO_ALL, congestion_control=wait)
        session.put(f"{OWN_ROBOT}/{place}", "from the session", congestion_control=wait)
        session.delete(f"{OWN_ROBOT}/{place}", congestion_control=wait)
    settle(session, witness)
    for subscriber in subscribers:
        subscriber.undeclare()
    return seen


def queries(session: zenoh.Session, witness: zenoh.Session) -> Seen:
    """A query, and a liveliness token of one that the other looks for, in both directions, at every key."""
    own, other = session.liveliness(), witness.liveliness()
    return {
        "ask": passing(
            session, witness, lambda key: session.get(key, timeout=1.0), witness.declare_queryable
        ),
        "answer": passing(
            session, witness, lambda key: witness.get(key, timeout=1.0), session.declare_queryable
        ),
        "watch": passing(session, witness, own.get, lambda key, _: other.declare_token(key)),
        "declare": passing(session, witness, other.get, lambda key, _: own.declare_token(key)),
    }


def passing(
    session: zenoh.Session,
    witness: zenoh.Session,
    get: Callable[..., Iterator[zenoh.Reply]],
    declare: Callable[..., Any],
) -> set[str]:
    """The keys at which `get` finds what `declare` offers on the other side."""
    offers = [declare(f"{OWN_ROBOT}/{place}", answer) for place in PLACES]
    settle(session, witness)
    replies = {place: get(f"{OWN_ROBOT}/{place}") for place in PLACES}
    found = {
        place
        for place, channel in replies.items()
        if any(reply.ok is not None for reply in channel)
    }
    for offer in offers:
        offer.undeclare()
    settle(session, witness)
    return found


def answer(query: zenoh.Query) -> None:
    query.reply(query.key_expr, "an answer")
    query.drop()


def relative(key: object) -> str:
    return str(key).removeprefix(f"{OWN_ROBOT}/")
