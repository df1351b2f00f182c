"""The report: sections, figures and words, on a made-up run whose forces are solved as the paper solves them."""

import dataclasses
import hashlib
import itertools
import json
import math
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.host_process import HostRecord
from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.model.robot import describe
from snakesim_hal.model.route import Route, lay_chain, sine_points
from snakesim_hal.model.scenario import RunConfig, Start, load
from snakesim_hal.model.scene import Cylinder, Ground, SceneFile, SineRoute, place, route_of
from snakesim_hal.wire.messages import ControlState, Description, Fault, Mode, World, WorldContact
from snakesim_operator.results.page.charts import strongest, thinned
from snakesim_operator.results.page.html import LIBRARY
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report import page as report_page
from snakesim_operator.results.report.events import drawn_instants, events
from snakesim_operator.results.report.instants import balanced_instants
from snakesim_operator.results.report.page import ELSEWHERE
from snakesim_operator.results.report.timeline import propulsion_intervals, reference_rad, state_bands
from snakesim_operator.results.report.verdict import Verdict, verdict
from snakesim_operator.results.report.view import nodes_xy_w
from snakesim_operator.results.summary import RunSummary, summarise

SECTIONS = ["playback", "overview", "instants", "joints", "loads", "numbers", "again"]
PLOTLY = LIBRARY.read_text(encoding="utf-8")
SVG_NAMESPACE = "http://www.w3.org/2000/svg"
RATE_HZ, SECONDS, FORCE_N, SPEED_M_S = 100.0, 10.0, 35.0, 0.05
RADIUS_M = 0.04
MOVING = ("position_w", "orientation_wxyz", "angle_rad")
INTERVALS_S = {6: (0.6, 2.9), 5: (2.9, 5.6), 4: (5.6, 7.8), 3: (7.8, 9.2)}  # joints 7, 6, 5, 4


# --- a made-up run ---------------------------------------------------------------------------------------------


def pegs() -> list[Cylinder]:
    """On alternating sides, alternately a little ahead of the inflections and behind them."""
    route = Route(sine_points(0.05, 0.6, 3.2))
    row: list[Cylinder] = []
    for k, s in enumerate(route.inflections_s_m()):
        s += 0.08 if k % 2 == 0 else -0.08
        (x, y), (tx, ty), side = route.at(s), route.tangent_w(s), (1 if k % 2 == 0 else -1)
        centre = (float(x + side * ty * 0.095), float(y - side * tx * 0.095))
        row.append(Cylinder(position_m=centre, radius_m=0.05, name=f"peg_{k}"))
    return row


def config() -> RunConfig:
    scene = SceneFile(
        name="sine",
        ground=Ground(friction=0.1),
        route=SineRoute(amplitude_m=0.05, wavelength_m=0.6, length_m=3.2),
        cylinder=pegs(),
    )
    shipped = load("triplet").config
    title = "Three push-points, made up"
    return msgspec.structs.replace(
        shipped, name="made_up", title=title, scene=scene, start=Start(), rate_hz=RATE_HZ, duration_s=SECONDS
    )


def propelling(time_s: float) -> int | None:
    return next((joint for joint, (start, end) in INTERVALS_S.items() if start <= time_s < end), None)


def push_points(run: RunConfig, route: Route, tail_s_m: float) -> list[WorldContact]:
    """The first three pegs beside the body whose forces balance."""
    body_m = run.robot.length_m
    pegs = [item.obstacle for item in place(run.scene)]
    beside = [(peg, route.project(np.array(peg.position_w[:2]))) for peg in pegs]
    beside = [(peg, s) for peg, s in beside if tail_s_m + 0.1 < s < tail_s_m + body_m - 0.02]
    contacts: list[WorldContact] = []
    for peg, s in beside:
        (x, y), (tx, ty) = route.at(s), route.tangent_w(s)
        side = np.sign((x - peg.position_w[0]) * -ty + (y - peg.position_w[1]) * tx)
        normal = (float(-ty * side), float(tx * side), 0.0)
        contacts.append(
            WorldContact(
                link=min(int((s - tail_s_m) / 0.11 + 0.5), 13),
                obstacle=peg.name,
                body_s_m=s - tail_s_m,
                position_w=(x - RADIUS_M * normal[0], y - RADIUS_M * normal[1], RADIUS_M),
                normal_w=normal,
                tangent_w=(float(tx), float(ty), 0.0),
                force_w=(0.0, 0.0, 0.0),
            )
        )
    for i in range(len(contacts) - 2):
        if min(solved(contacts[i : i + 3])) > 1:
            return contacts[i : i + 3]
    return []


def solved(contacts: list[WorldContact]) -> list[float]:
    """Equations (10) and (11) of the paper."""
    normals = np.array([c.normal_w[:2] for c in contacts])
    points = np.array([c.position_w[:2] for c in contacts])
    tether = -FORCE_N * np.array(contacts[0].tangent_w[:2])
    moments = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    about = points[0, 0] * tether[1] - points[0, 1] * tether[0]
    return np.linalg.solve(np.vstack([normals.T, moments]), -np.array([*tether, about])).tolist()


def finished(ticks: int) -> HostRecord:
    """What the host of a complete run leaves."""
    return HostRecord(
        ticks=ticks,
        wall_s=2.5,
        overruns=0,
        answered_ticks=ticks - 1,
        armed_ticks=ticks,
        command_digest="0123456789abcdef" * 4,
        state_to_command_us={"p50": 310.0, "p99": 905.5},
        rejected_commands={"stale": 2},
        limited_commands={"torque_rate": 41, "max_step": 7},
        faults=[],
        lifecycle="disarmed",
        why="finished",
    )


def made_up(folder: Path) -> RunRecord:
    run = config()
    route = route_of(run.scene)
    assert route is not None
    random = np.random.default_rng(3)
    count = int(SECONDS * RATE_HZ)
    time_s = 0.37 + np.arange(count) / RATE_HZ
    lengths = run.robot.link_lengths_m
    angle, target, position, orientation = (np.zeros((count, k)) for k in (13, 13, 3, 4))
    waves = np.sin(np.linspace(0, 9, count).reshape(-1, 1) + np.arange(13))
    torque = 0.4 * waves + 0.05 * random.normal(size=(count, 13))
    mode = np.full((count, 13), Mode.POSITION, dtype=np.int8)
    peak, touched = np.zeros(count), np.zeros(count)
    control: list[ControlState] = []
    worlds: list[World] = []
    for row, t in enumerate(time_s - time_s[0]):
        tail_s = 0.05 + SPEED_M_S * min(max(t - 0.6, 0.0), 8.6)
        lie = lay_chain(route, tail_s, lengths)
        angle[row] = lie.angles_rad + 0.004 * random.normal(size=13)
        target[row] = lie.angles_rad
        position[row] = (*lie.tail_w, RADIUS_M)
        orientation[row] = quaternion_from_yaw(lie.heading_rad)
        joint = propelling(t)
        points = push_points(run, route, tail_s) if joint is not None else []
        forces = solved(points) if points else []
        if joint is not None:
            ramp = min(1.0, 4 * (t - INTERVALS_S[joint][0]))
            asked = 9.0 * np.sin(2.2 * t + joint)
            angle[row, joint] += 0.05 * ramp * np.sin(3 * t)
            mode[row, joint], target[row, joint] = Mode.TORQUE, np.clip(asked, -7, 7)
            torque[row, joint] = np.clip(asked + 0.2 * random.normal(), -7, 7)
            peak[row], touched[row] = max(forces) * (1 + 0.1 * random.normal()), 3
        stamp_ns = round((0.37 + t) * 1e9)
        if row % 5 == 0 or joint != propelling(t - 1 / RATE_HZ):
            control.append(
                ControlState(
                    tick=row + 37,
                    stamp_ns=stamp_ns,
                    controller="obstacle_triplet",
                    state="Locomoting" if joint is not None else "NotLocomoting",
                    reason="pushing" if joint is not None else "2 usable push-points, 3 are needed",
                    path_s_m=tail_s,
                    propulsion_joint=None if joint is None else f"joint_{joint + 1}",
                    propulsion_n=FORCE_N if joint is not None else None,
                    push_points=points,
                    solved_force_n=forces,
                    propulsion_torque_nm=None if joint is None else float(target[row, joint]),
                    reference_rad=lie.angles_rad.tolist(),
                    torque_headroom_nm=1.5 if joint is not None else None,
                    condition=12.0,
                )
            )
        if row % 10 == 0:
            felt = [
                msgspec.structs.replace(
                    point,
                    force_w=(
                        force * point.normal_w[0] * 0.8 - 0.5 * point.tangent_w[0],
                        force * point.normal_w[1] * 0.8 - 0.5 * point.tangent_w[1],
                        0.0,
                    ),
                )
                for point, force in zip(points, forces, strict=True)
            ]
            worlds.append(
                World(
                    tick=row + 37,
                    stamp_ns=stamp_ns,
                    base_position_w=(*lie.tail_w, RADIUS_M),
                    base_orientation_wxyz=quaternion_from_yaw(lie.heading_rad),
                    base_confidence=1.0,
                    contacts=felt,
                    obstacles=[],
                )
            )
    return RunRecord(
        folder=folder,
        config=run,
        description=describe(run.robot, backend="sim", period_ns=run.period_ns, lease_ns=run.lease_ns, config_hash="x"),
        host=finished(count),
        control=control,
        worlds=worlds,
        time_s=time_s,
        angle_rad=angle,
        velocity_rad_s=np.diff(angle, axis=0, prepend=angle[:1]) * RATE_HZ,
        torque_nm=torque,
        mode=mode,
        target=target,
        torque_limit_nm=np.full((count, 13), 7.0),
        position_w=position,
        orientation_wxyz=orientation,
        contact_peak_n=peak,
        contact_count=touched,
    )


# --- reading the page ------------------------------------------------------------------------------------------


class Reader(HTMLParser):
    """Collects what the tests ask for, and refuses tags that do not match."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.words: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.titles: list[str] = []  # of drawings and charts
        self.charts: dict[str, Any] = {}
        self.film: dict[str, Any] = {}
        self._open: list[str] = []
        self.feed(page.replace(PLOTLY, ""))
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "br", "link", "input"):
            self._open.append(tag)
        self._note(tag, attrs)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._note(tag, attrs)

    def _note(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.attributes += [(tag, name, value) for name, value in attrs]
        if given.get("id"):
            self.ids.append(str(given["id"]))
        if tag in ("svg", "figure") and given.get("aria-label"):
            self.titles.append(str(given["aria-label"]))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open[-1:] == ["script"] and data.startswith("{"):
            told = json.loads(data)
            if "frames" in told:
                self.film = told
            else:
                self.charts[told["label"]] = told
        elif not {"style", "script", "pre"} & set(self._open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def read(record: RunRecord, ended: str = "complete") -> Reader:
    page = report_page(record, summarise(record, ended))
    reader = Reader(page)
    assert [i for i in reader.ids if i in SECTIONS] == SECTIONS
    assert len(page.encode()) < 3_000_000
    assert not [a for a in reader.attributes if a[2] is not None and re.search(r"\b(nan|inf|None)\b", a[2])]
    assert not re.search(r"\b(None|nan|inf)\b", reader.text)
    assert not [a for a in reader.attributes if a[1] in ("src", "href")]
    ours = page.replace(PLOTLY, "")
    assert len(ours) < len(page) and not re.search(r"@import|url\(|https?://", ours.replace(SVG_NAMESPACE, ""))
    return reader


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    return made_up(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(record: RunRecord) -> Reader:
    return read(record)


def changed(record: RunRecord, **fields: Any) -> RunRecord:
    return dataclasses.replace(record, **fields)


# --- a whole run -----------------------------------------------------------------------------------------------


def test_the_verdict_tells_distance_and_hand_over(page: Reader) -> None:
    said = (
        "Moved 0.43 m along the path in 10.0 s; propulsion handed over joint_7 → joint_6 → joint_5 → joint_4; "
        "no fault, 2 commands refused (stale)."
    )
    assert said in page.text
    assert "Locomotion ended at 9.2 s of 10.0 s: 2 usable push-points, 3 are needed." in page.text


def test_playback_moves_the_snake_over_a_map(record: RunRecord, page: Reader) -> None:
    frames = page.film["frames"]
    assert frames[0][0] == 0 and frames[-1][0] == pytest.approx(SECONDS, abs=0.02) and 200 < len(frames) < 400
    assert all(len(nodes) == 2 * 15 for _, nodes, *_ in frames)
    propels = {joint for _, _, joint, *_ in frames}
    assert propels == {-1, *INTERVALS_S}
    pushing = [frame for frame in frames if frame[2] >= 0]
    assert all(len(solved) == 16 and len(felt) == 12 for *_, solved, felt in pushing[5:-5])
    assert page.film["said"][frames[0][3]] == "not moving: 2 usable push-points, 3 are needed"


def test_every_series_of_the_run_is_a_chart(page: Reader) -> None:
    assert list(page.charts) == [
        "Advance over time",
        "States and propulsion joint over time",
        *(f"{what} of joint_{n} over time" for n in (7, 6, 5, 4) for what in ("Angle", "Torque")),
        "Torque of every joint over time",
        "Largest torque of any joint as a share of its limit",
        "Strongest contact force over time",
        "Obstacles touched over time",
    ]
    torque = page.charts["Torque of joint_7 over time"]
    assert [line["name"] for line in torque["data"]] == ["measured", "commanded"]
    shade, *_ = torque["layout"]["shapes"]
    assert (shade["x0"], shade["x1"]) == pytest.approx(INTERVALS_S[6], abs=0.051)
    assert shade["fillcolor"] == "--joint-6"
    commanded = dict(zip(torque["data"][1]["x"], torque["data"][1]["y"], strict=True))
    assert commanded[0.0] is None and commanded[1.0] is not None  # unknown is a gap
    (torques,) = page.charts["Torque of every joint over time"]["data"]
    assert len(torques["z"]) == 13 and len(torques["z"][0]) == 480


def test_instants_are_events_and_none_looks_like_another(record: RunRecord, page: Reader) -> None:
    found = events(record, summarise(record, "complete"))
    assert [one.joint for one in found if one.joint is not None] == list(INTERVALS_S)
    assert found[0].words == "Start" and found[-1].words == "Stop"
    assert sum(one.words.startswith("Largest contact force") for one in found) == 1
    drawn = drawn_instants(record, found)
    bodies = [nodes_xy_w(record, instant) for _, instant in drawn]
    assert all(np.abs(a - b).max() > 0.004 for a, b in itertools.combinations(bodies, 2))
    said = "; ".join(event.words for event, _ in drawn)
    for words in ("Start", "joint_7 begins to propel", "Hand-over to joint_4", "Largest contact force", "Stop"):
        assert words in said
    assert len([title for title in page.titles if title.startswith("Top view at")]) == len(drawn)


def test_forces_balance_and_add_up_to_the_commanded_one(record: RunRecord) -> None:
    found = balanced_instants(record)
    assert len(found) > 50
    for one in found:
        assert one.balance is not None and one.balance.gap_n < 1e-9 * FORCE_N
        ahead = FORCE_N * np.array(one.balance.contacts[0].tangent_w[:2])
        assert np.allclose(one.balance.resultant_n, ahead, atol=1e-9)


def test_all_polygons_have_one_scale_and_show_the_commanded_force(page: Reader, record: RunRecord) -> None:
    html = report_page(record, summarise(record, "complete"))
    polygons = re.findall(r'<svg viewBox="[^"]*" class="figure" role="img" aria-label="Force polygon.*?</svg>', html)
    lengths = [math.dist(*edge) for svg in polygons for edge in drawn_edges(svg, "commanded")]
    assert len(lengths) == len(polygons) > 2
    assert max(lengths) - min(lengths) < 0.5  # always FORCE_N
    ring = drawn_edges(polygons[0], "solved")
    assert math.dist(ring[0][0], ring[-1][1]) == pytest.approx(lengths[0], abs=0.5)


def test_no_text_of_a_drawing_covers_another_and_no_obstacle_is_cut(record: RunRecord) -> None:
    html = report_page(record, summarise(record, "complete"))
    drawings = [
        ET.fromstring(found) for found in re.findall(r'<svg viewBox="[^"]*" class="figure" role.*?</svg>', html)
    ]
    assert len(drawings) > 8
    for drawing in drawings:
        for (a, first), (b, second) in itertools.combinations([(t.text, box_of(t)) for t in drawing.iter("text")], 2):
            wide = min(first[2], second[2]) - max(first[0], second[0])
            high = min(first[3], second[3]) - max(first[1], second[1])
            assert wide <= 1 or high <= 2, f"{a!r} and {b!r} in {drawing.get('aria-label')}"
        width, height = map(float, drawing.attrib["viewBox"].split()[2:])
        for x, y, r in [[float(c.attrib[k]) for k in ("cx", "cy", "r")] for c in drawing.iter("circle")]:
            assert r <= x <= width - r and r <= y <= height - r


def box_of(item: ET.Element) -> tuple[float, float, float, float]:
    x, y, width = float(item.attrib["x"]), float(item.attrib["y"]), 6.2 * len(item.text or "")
    left = {"start": x, "middle": x - width / 2, "end": x - width}[item.get("text-anchor", "start")]
    return left, y - 10, left + width, y + 1


def drawn_edges(svg: str, kind: str) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """From where a shaft starts to where its head ends, in the order of drawing."""
    items = [item for item in ET.fromstring(svg).iter() if item.get("class", "").startswith(f"{kind} ")]
    tips = [item.attrib["points"].split()[0].split(",") for item in items[1::2]]
    starts = [(float(item.attrib["x1"]), float(item.attrib["y1"])) for item in items[::2]]
    return [(start, (float(x), float(y))) for start, (x, y) in zip(starts, tips, strict=True)]


def test_a_polygon_that_does_not_close_is_no_instant(record: RunRecord) -> None:
    more = [
        msgspec.structs.replace(one, solved_force_n=[1.3 * f for f in one.solved_force_n]) for one in record.control
    ]
    wrong = changed(record, control=more)
    assert balanced_instants(wrong) == [] and "whose forces balance" in read(wrong).text


def test_every_number_of_the_summary_stands_in_the_table_with_its_unit(record: RunRecord, page: Reader) -> None:
    for field in msgspec.structs.fields(RunSummary):
        if field.name not in ELSEWHERE:
            assert field.name in page.words, field.name
    assert {"N·m", "m/s", "µs", "J", "Hz"} <= set(page.words)
    assert "torque_rate" in page.words and "41" in page.words  # limited by the gate
    assert "stale" in page.words


def test_the_page_says_how_to_repeat_the_run(record: RunRecord) -> None:
    page = report_page(record, summarise(record, "complete"))
    assert f"snakesim run {record.folder}/config.json --backend sim --seed 1" in page
    assert "&#34;amplitude_m&#34;: 0.05" in page


# --- runs with something missing -------------------------------------------------------------------------------


def test_without_telemetry(record: RunRecord) -> None:
    page = read(changed(record, control=[], worlds=[]))
    assert "telemetry holds no message of the controller" in page.text
    assert "No joint propelled" in page.text
    assert len([title for title in page.titles if title.startswith("Top view")]) == 3  # the pose is known


def test_the_page_of_a_long_run_is_no_larger(record: RunRecord) -> None:
    """Ten runs a minute, for ten minutes."""
    times = 60
    told = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    long = {name: np.concatenate([one] * times) for name, one in told.items() if isinstance(one, np.ndarray)}
    long["time_s"] = 0.37 + np.arange(len(long["time_s"])) / RATE_HZ
    later = [
        [
            msgspec.structs.replace(one, stamp_ns=one.stamp_ns + round(k * SECONDS * 1e9))
            for k in range(times)
            for one in told
        ]
        for told in (record.control, record.worlds)
    ]
    page = read(changed(record, control=later[0], worlds=later[1], **long))  # holds the size against the limit
    assert len(page.film["frames"]) <= 300 and "handed over 239 times among 4 joints" in page.text


def test_without_a_pose(record: RunRecord) -> None:
    count = len(record.time_s)
    blind = changed(record, position_w=np.full((count, 3), np.nan), orientation_wxyz=np.full((count, 4), np.nan))
    page = read(blind)
    assert "it has no pose sensor" in page.text
    assert not [title for title in page.titles if title.startswith("Top view")]
    assert "as the controller knew it" in page.text  # distance from the controller's own place on the path


def test_without_a_route(record: RunRecord) -> None:
    scene = msgspec.structs.replace(record.config.scene, route=None)
    start = Start(on_route=False, position_m=(-5.0, 0.0))
    page = read(changed(record, config=msgspec.structs.replace(record.config, scene=scene, start=start)))
    assert "distance of the tail end" in page.text
    assert "net displacement" in page.text


def test_without_ticks(record: RunRecord) -> None:
    fields = [field.name for field in dataclasses.fields(record)]
    empty = {name: getattr(record, name)[:0] for name in fields if isinstance(getattr(record, name), np.ndarray)}
    host = msgspec.structs.replace(record.host, ticks=0, armed_ticks=0, answered_ticks=0)
    page = read(changed(record, control=[], worlds=[], host=host, **empty), "the host never became ready")
    assert "Nothing was recorded: the robot was never armed (the host never became ready)." in page.text


def test_without_a_contact_sensor(record: RunRecord) -> None:
    sensors = msgspec.structs.replace(record.config.robot.sensors, contacts=None)
    robot = msgspec.structs.replace(record.config.robot, sensors=sensors)
    page = read(changed(record, config=msgspec.structs.replace(record.config, robot=robot)))
    assert "No contact forces: the robot has no contact sensor." in page.text


def test_a_controller_without_push_points(record: RunRecord) -> None:
    nothing = {"push_points": [], "solved_force_n": [], "propulsion_joint": None, "propulsion_n": None}
    plain = [msgspec.structs.replace(state, controller="hold", **nothing) for state in record.control]
    config_ = msgspec.structs.replace(record.config, controller="hold")
    page = read(changed(record, control=plain, config=config_))
    assert "controller hold solved for no push-points" in page.text
    assert "controller hold named no propulsion joint" in page.text
    assert "measured contacts, in sum" in page.text


def test_a_run_that_went_on_without_a_joint(record: RunRecord) -> None:
    lost = Fault(tick=537, what="joint_frozen", cause="joint_3 repeats itself", joint="joint_3", reach="joint")
    page = read(changed(record, host=msgspec.structs.replace(record.host, faults=[lost], isolated=["joint_3"])))
    assert "went on without joint_3, 2 commands refused" in page.text and "Stopped by a fault" not in page.text
    stop = Fault(tick=600, what="leak", cause="joint_4 reports water inside", joint="joint_4")
    page = read(changed(record, host=msgspec.structs.replace(record.host, faults=[lost, stop])), stop.cause)
    assert "Stopped by a fault" in page.text and "at joint_4: joint_4 reports water inside." in page.text


def test_a_run_that_ended_by_a_fault(record: RunRecord) -> None:
    fault = Fault(tick=537, what="diverged", cause="joint_3 at 1e9 rad/s", joint="joint_3")
    page = read(changed(record, host=msgspec.structs.replace(record.host, faults=[fault])), fault.cause)
    assert "Stopped by a fault after 5.0 s at joint_3: joint_3 at 1e9 rad/s." in page.text
    assert "diverged" in page.words
    marks = [shape for chart in page.charts.values() for shape in chart["layout"]["shapes"]]
    assert [mark["line"].get("color") for mark in marks].count("--bad") == 2 + 8 + 3


def test_a_run_that_jammed(record: RunRecord) -> None:
    page = read(stopped_at(record, 0.0, jammed=True, reason="jammed at peg_2"))
    assert "Jammed: jammed at peg_2. Moved 0.00 m along the path in 10.0 s; no fault, 2 commands refused" in page.text
    assert "jam" in page.charts["States and propulsion joint over time"]["data"][0]["y"]


def test_a_run_that_moved_and_then_jammed_is_called_jammed(record: RunRecord) -> None:
    stuck = [
        msgspec.structs.replace(state, jammed=True, reason="jammed: wedged") if state.stamp_ns > 9.565e9 else state
        for state in record.control
    ]
    page = read(changed(record, control=stuck))
    assert "Jammed at 9.2 s of 10.0 s: wedged. Moved 0.43 m along the path" in page.text


def stopped_at(record: RunRecord, at_s: float, **state: Any) -> RunRecord:
    """The same run, in which nothing moves any more from a time on, and control tells this."""
    row = record.row_at(float(record.time_s[0]) + at_s)
    held = {name: getattr(record, name).copy() for name in MOVING}
    for column in held.values():
        column[row:] = column[row]
    since_ns = (float(record.time_s[0]) + at_s) * 1e9
    control = [msgspec.structs.replace(one, **state) if one.stamp_ns > since_ns else one for one in record.control]
    return changed(record, control=control, **held)


def judged(record: RunRecord) -> Verdict:
    return verdict(record, summarise(record, "complete"))


def test_a_run_that_stood_still_for_most_of_its_time_is_no_good_one(record: RunRecord) -> None:
    assert judged(record).kind == "good"
    lost = judged(stopped_at(record, 4.0, state="NotLocomoting", reason="2 usable push-points, 3 are needed"))
    assert lost.kind == "poor"
    assert lost.words.startswith("Stopped at 4.0 s of 10.0 s: 2 usable push-points, 3 are needed. Moved 0.")
    late = judged(stopped_at(record, 6.5, state="NotLocomoting", reason="2 usable push-points, 3 are needed"))
    assert late.kind == "good" and "Locomotion ended at 6.6 s of 10.0 s: 2 usable push-points" in late.words


def test_a_jam_is_one_whatever_control_told_at_the_very_end(record: RunRecord) -> None:
    """A controller that tries again and again, and each time says for a moment that it moves."""
    stuck = stopped_at(record, 6.0, state="NotLocomoting", reason="jammed: wedged", jammed=True)
    trying = [*stuck.control[:-1], msgspec.structs.replace(stuck.control[-1], state="Locomoting", reason="pushing")]
    found = judged(changed(stuck, control=trying))
    assert found.kind == "poor" and found.words.startswith("Jammed at 5.9 s of 10.0 s: wedged. Moved")
    claims = judged(stopped_at(record, 4.0, state="Locomoting", reason="pushing"))
    assert claims.kind == "poor" and "its controller reported Locomoting all the same" in claims.words


def test_a_run_that_rests_at_the_end_of_its_path_has_not_failed(record: RunRecord) -> None:
    rests = judged(stopped_at(record, 4.0, state="Idle", reason="no motion intended: the path is finished"))
    assert rests.kind == "good" and "Locomotion ended at 4.0 s" in rests.words


def test_who_says_nothing_more_is_not_known_to_move(record: RunRecord) -> None:
    silent = [state for state in record.control if state.stamp_ns < 4.37e9]
    assert silent[-1].state == "Locomoting"
    told = summarise(changed(record, control=silent), "complete").locomoting_fraction
    whole = summarise(record, "complete").locomoting_fraction
    assert told == pytest.approx((4.0 - 0.8 + 0.5) / 10.0, abs=0.06) and whole == pytest.approx(0.84, abs=0.06)


def test_a_controller_that_says_it_moves_and_does_not(record: RunRecord) -> None:
    found = judged(stopped_at(record, 0.0, state="Locomoting", reason="moving"))
    assert (
        "Did not locomote: the snake stayed where it was, although its controller reported Locomoting." in found.words
    )


def test_text_from_outside_is_escaped(record: RunRecord) -> None:
    nasty = '<script>alert("x")</script>&'
    config_ = msgspec.structs.replace(record.config, title=nasty)
    told = [msgspec.structs.replace(state, reason=nasty, state="NotLocomoting") for state in record.control]
    host = msgspec.structs.replace(record.host, faults=[Fault(tick=90, what=nasty, cause=nasty)])
    hurt = changed(record, config=config_, control=told, host=host)
    page = report_page(hurt, summarise(hurt, nasty))
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert") >= 5
    assert nasty in Reader(page).text


def test_names_from_outside_are_escaped_and_turn_no_text_around(record: RunRecord) -> None:
    nasty = "</title><script>alert(1)\u202e\x9b31m\x1b[31m\u2028"
    encoded = msgspec.json.encode(record.description).replace(b"joint_", msgspec.json.encode(nasty)[1:-1])
    told = [
        msgspec.structs.replace(one, propulsion_joint=one.propulsion_joint.replace("joint_", nasty))
        if one.propulsion_joint
        else one
        for one in record.control
    ]
    pegs_ = [msgspec.structs.replace(peg, name=f"{nasty}{i}") for i, peg in enumerate(record.config.scene.cylinder)]
    scene = msgspec.structs.replace(record.config.scene, cylinder=pegs_)
    config_ = msgspec.structs.replace(record.config, scene=scene)
    hurt = changed(record, description=msgspec.json.decode(encoded, type=Description), control=told, config=config_)
    page = report_page(hurt, summarise(hurt, "complete"))
    assert propulsion_intervals(hurt) and "<script>alert" not in page and "&lt;script&gt;alert" in page
    assert not {"\u202e", "\x9b", "\x1b", "\u2028"} & set(page) and "\\u202e\\u009b31m" in page


def test_a_snake_that_lies_upwards_is_turned(record: RunRecord) -> None:
    count = len(record.time_s)
    up = changed(
        record,
        position_w=record.position_w[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0]),
        orientation_wxyz=np.tile(quaternion_from_yaw(math.pi / 2 + 0.4), (count, 1)),
        worlds=[],
        control=[],
    )
    sizes = [
        [float(n) for n in value.split()][2:]
        for _, name, value in read(up).attributes
        if name == "viewbox" and value and value.startswith("0 0 500 ")
    ]
    assert len(sizes) == 3
    assert all(height < width for width, height in sizes)


# --- parts -----------------------------------------------------------------------------------------------------


def test_intervals_and_bands_follow_the_telemetry(record: RunRecord) -> None:
    intervals = propulsion_intervals(record)
    assert [one.joint for one in intervals] == list(INTERVALS_S)
    for one in intervals:
        assert (one.start_s, one.end_s) == pytest.approx(INTERVALS_S[one.joint], abs=0.051)
    assert [band.what for band in state_bands(record)] == ["NotLocomoting", "Locomoting", "NotLocomoting"]
    assert state_bands(record)[-1].end_s == pytest.approx(SECONDS)


def test_the_reference_is_the_target_in_position_mode_and_the_controllers_word_in_torque_mode(
    record: RunRecord,
) -> None:
    reference = reference_rad(record, 6)
    free = record.mode[:, 6] == Mode.TORQUE
    assert np.array_equal(reference[~free], record.target[~free, 6])
    assert np.abs(reference[free] - record.target[free, 6]).max() > 1  # no torque is taken for an angle
    assert np.abs(np.diff(reference)).max() < 0.05  # one smooth line


def test_thinning_keeps_extremes_and_gaps() -> None:
    values = np.sin(np.linspace(0.0, 100.0, 100_000))
    values[54_321], values[12_345], values[70_000:71_000] = 9.0, -9.0, np.nan
    kept = values[thinned(values)]
    assert len(kept) <= 1510 and np.nanmax(kept) == 9.0 and np.nanmin(kept) == -9.0 and np.isnan(kept).any()
    columns = strongest(np.stack([values, np.full_like(values, np.nan)], axis=1), 480)
    assert columns.shape == (480, 2) and np.nanmax(columns) == 9.0 and np.nanmin(columns) == -9.0


def test_the_plotting_library_is_the_one_that_its_note_names() -> None:
    digest = hashlib.sha256(LIBRARY.read_bytes()).hexdigest()
    assert f"`{LIBRARY.name}`" in (note := (LIBRARY.parent / "README.md").read_text()) and digest in note
    assert (LIBRARY.parent / "LICENSE-plotly.txt").is_file()
