"""Robot files to URDF and back, URDFs from elsewhere, and MuJoCo's own importer as an independent reader."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import decode_table, list_shipped_names, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario, parse_set_option
from snakesim_operator.cli import main
from snakesim_operator.features.robots.command import export_robot, import_robot
from snakesim_operator.features.robots.exporting import format_urdf
from snakesim_operator.features.robots.imported import ImportOptions, ImportResult
from snakesim_operator.features.robots.importing import import_urdf
from snakesim_operator.features.robots.meshes import read_mesh_vertices
from snakesim_operator.features.robots.toml_text import format_toml
from snakesim_operator.run.in_process import simulate
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.messages import raises_error

HERE = Path(__file__).parent / "urdf"
SLIDER, HEXA = HERE / "slider8.urdf", HERE / "hexa_snake_mm.urdf"
HEXA_ORDER = ImportOptions(scale=0.001, up="y")
READ_ALL = '<mujoco><compiler fusestatic="false" discardvisual="false" strippath="true" meshdir="{}"/></mujoco></robot>'


def config(scenario: str, robot: Path, *sets: str) -> RunConfig:
    return load_scenario(
        scenario, [KeyOverride("robot", str(robot), "--set"), *map(parse_set_option, sets)]
    ).config


def robot_at(name: str | Path) -> RobotFile:
    return decode_table(read_table_with_base(str(name), "robots"), RobotFile)


def by_mujoco(text: str, meshes: Path = HERE) -> mujoco.MjModel:
    """As MuJoCo's own importer reads a URDF."""
    return mujoco.MjModel.from_xml_string(text.replace("</robot>", READ_ALL.format(meshes)))


def hinge_inertia(model: mujoco.MjModel) -> np.ndarray:
    """Inertia matrix of the hinges at zero angles, without rotors, (n_joints, n_joints)."""
    model.dof_armature[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    hinges = [
        model.jnt_dofadr[i]
        for i in range(model.njnt)
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE
    ]
    return full[np.ix_(hinges, hinges)]


def ours(found: ImportResult, tmp_path: Path) -> mujoco.MjModel:
    (tmp_path / "robot.toml").write_text(format_toml(found.table.values, []))
    return simulated(tmp_path / "robot.toml")


def simulated(robot: Path) -> mujoco.MjModel:
    """The simulator's model, the robot beside the obstacles."""
    beside = config("peg_row", robot, "start.on_route=false", "start.position_m=[-9.0, 9.0]")
    return build_sim_model(beside, SimSettings()).model


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_urdf_round_trip_keeps_every_shipped_robot(name: str, tmp_path: Path) -> None:
    file, back = tmp_path / "robot.urdf", tmp_path / "robot.toml"
    export_robot(name, file)
    import_robot(file, ImportOptions(), back)
    assert robot_at(back) == robot_at(name)


def test_urdf_round_trip_keeps_limits_and_friction_of_each_joint(tmp_path: Path) -> None:
    own, back, edited = tmp_path / "own.toml", tmp_path / "back.toml", tmp_path / "edited.urdf"
    own.write_text(
        'extends = "planar13"\nname = "own"\n[drive]\ngear = 1.5\n'
        "[joints.joint_2]\nsign = -1\nzero_rad = 0.3\nangle_min_rad = -0.4\nspeed_rad_s = 3.0\n"
        "[joints.joint_5]\nangle_rad = 0.8\ntorque_nm = 2.5\nfriction_nm = 0.1\nvoltage_v = 22.0\n"
    )
    export_robot(str(own), tmp_path / "own.urdf")
    import_robot(tmp_path / "own.urdf", ImportOptions(), back)
    robot = robot_at(own)
    assert robot_at(back) == robot
    theirs = by_mujoco(format_urdf(robot))
    assert theirs.joint("joint_2").range == pytest.approx([-0.4, 1.5708])
    assert theirs.joint("joint_5").range == pytest.approx([-0.8, 0.8])
    assert theirs.joint("joint_5").frictionloss[0] == 0.1
    assert theirs.joint("joint_4").frictionloss[0] == 0.0
    text = (tmp_path / "own.urdf").read_text()
    assert text.count('lower="-0.4"') == 1
    edited.write_text(text.replace('lower="-0.4"', 'lower="-0.7"'))
    found = import_urdf(edited, ImportOptions())
    assert found.robot.joint_table[1].limits.lower_rad == -0.7, (
        "what was changed in the URDF counts"
    )
    assert (
        "angle_min_rad differs from that of the others: joint_2 (joint_2) -0.7 rad" in found.changed
    )


def test_urdf_import_has_exceptions_only_for_differing_joints() -> None:
    slider, hexa = import_urdf(SLIDER, ImportOptions()).robot, import_urdf(HEXA, HEXA_ORDER).robot
    assert slider.limits.torque_nm == 4.1
    assert len(slider.joints) == 1
    assert [joint.limits.torque_nm for joint in slider.joint_table].count(3.8) == 1
    sides = [(joint.limits.lower_rad, joint.limits.upper_rad) for joint in hexa.joint_table]
    assert sides == [(-1.5, 1.5), (-1.4, 1.6), *[(-1.5, 1.5)] * 4], "its angle is negated"


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_mujocos_own_importer_reads_the_same_bodies_joints_and_shapes(name: str) -> None:
    robot = robot_at(name)
    theirs = by_mujoco(format_urdf(robot))
    own = simulated(Path(name))
    np.testing.assert_allclose(hinge_inertia(theirs), hinge_inertia(own), rtol=1e-6, atol=1e-9)
    for i in range(robot.chain.modules + 1):
        a, b = theirs.body(f"link_{i}"), own.body(f"link_{i}")
        np.testing.assert_allclose(
            [a.mass[0], *np.sort(a.inertia)], [b.mass[0], *np.sort(b.inertia)], rtol=1e-6
        )
        np.testing.assert_allclose(a.ipos, b.ipos, atol=1e-9)
        sizes = [theirs.geom_size[g] for g in range(theirs.ngeom) if theirs.geom_bodyid[g] == a.id]
        capsule = own.geom(f"link_{i}").size
        assert {tuple(size[:1]) for size in sizes} == {(capsule[0],)}
        assert max(size[1] for size in sizes) == pytest.approx(capsule[1])
    for i, axis in enumerate(robot.axes):
        joint = theirs.joint(f"joint_{i + 1}")
        assert joint.axis.tolist() == ([0, 0, 1] if axis == "yaw" else [0, 1, 0])
        limits = robot.joint_table[i].limits
        assert joint.range == pytest.approx([limits.lower_rad, limits.upper_rad])


def test_urdf_import_planar_snake_has_inertia_of_mujoco(tmp_path: Path) -> None:
    found = import_urdf(SLIDER, ImportOptions())
    theirs = by_mujoco(SLIDER.read_text(), HERE / "meshes")
    sign = np.array(
        [-1.0 if "hinge0" in name and "negated" in name else 1.0 for name in found.names[9:]]
    )
    np.testing.assert_allclose(
        hinge_inertia(ours(found, tmp_path)),
        hinge_inertia(theirs) * np.outer(sign, sign),
        rtol=1e-6,
    )
    assert found.robot.module.radius_m == pytest.approx(np.hypot(0.015, 0.03)), (
        "of the covers' boxes"
    )


def test_urdf_import_alternating_millimeter_snake_has_inertia_of_mujoco(tmp_path: Path) -> None:
    whole = HEXA.read_text().replace('ixx="0" iyy="0" izz="0"', 'ixx="110" iyy="120" izz="50"')
    (tmp_path / "whole.urdf").write_text(whole)
    found = import_urdf(tmp_path / "whole.urdf", HEXA_ORDER)
    assert found.robot.axes == ["yaw", "pitch"] * 3
    sign = np.array([-1.0 if "negated" in name else 1.0 for name in found.names[7:]])
    theirs = hinge_inertia(by_mujoco(whole)) * 1e-6 * np.outer(sign, sign)
    np.testing.assert_allclose(hinge_inertia(ours(found, tmp_path)), theirs, rtol=1e-6, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "order", "scenario", "controller"),
    [
        (SLIDER, ImportOptions(tail="seg08"), "peg_row", "obstacle_triplet"),
        (HEXA, HEXA_ORDER, "mamba_hills", "lateral_undulation"),
    ],
)
def test_urdf_import_of_foreign_snakes_can_run(
    file: Path, order: ImportOptions, scenario: str, controller: str, tmp_path: Path
) -> None:
    robot = tmp_path / "robot.toml"
    import_robot(file, order, robot)
    result = simulate(config(scenario, robot, f"controller={controller}", "duration_s=2"))
    assert result.summary.ended == "complete"
    assert np.abs(np.diff(result.record.angle_rad, axis=0)).max() > 1e-3, "its joints move"
    again, exported = tmp_path / "again.toml", tmp_path / "again.urdf"
    export_robot(str(robot), exported)
    import_robot(exported, ImportOptions(), again)
    assert robot_at(again) == robot_at(robot)


def test_urdf_import_names_values_it_cannot_express() -> None:
    slider, hexa = import_urdf(SLIDER, ImportOptions()), import_urdf(HEXA, HEXA_ORDER)
    left_out, changed = (
        "\n".join(slider.left_out + hexa.left_out),
        "\n".join(slider.changed + hexa.changed),
    )
    for words in (
        "<transmission> left out: lines 26, 41",
        "<gazebo><plugin>",
        "<safety_controller>",
        "sensor 'nose' is rolled",
    ):
        assert words in left_out
    for words in (
        "hinge02",
        "continuous",
        "torque_nm differs from that of the others: joint_",
        ") 3.8 N·m",
        "link_3 has an inertia that no body has",
        "angle_max_rad differs from that of the others: joint_2 (b_c) 1.6 rad",  # -1.6 to 1.4, and negated
    ):
        assert words in changed
    assert hexa.robot.sensors.depth[0].position_m == pytest.approx((0.07, 0.0, 0.0))
    assert hexa.robot.sensors.imu is not None


TURNS = '<axis xyz="0 0 1"/><limit lower="-1" upper="1"/>'
TWO = f"""<robot name="two"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j1" type="revolute"><parent link="a"/><child link="b"/>{TURNS}</joint>
<joint name="j2" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.1 0 0"/>{TURNS}</joint></robot>"""
ROUND = '<link name="r"/><joint name="j3" type="fixed"><parent link="c"/><child link="a"/></joint></robot>'
BAD = {
    "entities": '<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>',
    "not XML": "<robot>",
    "xacro": '<robot name="r" xmlns:xacro="x"><xacro:include filename="a"/></robot>',
    "deep": "<a>" * 40 + "</a>" * 40,
    "SDF": "<sdf/>",
    "a slider": TWO.replace('"revolute"', '"prismatic"', 1),
    "a fork": TWO.replace('link="b"/><child link="c"', 'link="a"/><child link="c"'),
    "a circle": TWO.replace("</robot>", ROUND),
    "no such link": TWO.replace('child link="c"', 'child link="d"'),
    "oblique": TWO.replace('"0 0 1"', '"0 1 1"', 1),
    "mimic": TWO.replace("<limit", '<mimic joint="j2"/><limit', 1),
    "no limits": TWO.replace('<limit lower="-1" upper="1"/>', "", 1),
    "a stop at zero": TWO.replace('lower="-1"', 'lower="0"', 1),
    "not a number": TWO.replace('"0.1 0 0"', '"nan 0 0"'),
    "in millimetres": TWO.replace('"0.1 0 0"', '"110 0 0"'),
}


@pytest.mark.parametrize("case", BAD)
def test_urdf_import_of_other_robot_is_refused_with_place(case: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(BAD[case])
    with raises_error(ConfigError, code="urdf/invalid"):
        import_urdf(file, ImportOptions())


def test_urdf_import_report_is_available_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            [
                "robot",
                "import",
                str(SLIDER),
                "--out",
                str(tmp_path / "a.toml"),
                "--tail",
                "seg08",
                "--json",
            ]
        )
        == 0
    )
    reported = json.loads(capsys.readouterr().out)
    assert reported["file"] == str(tmp_path / "a.toml")
    assert "joint_1: hinge08 (line 122), yaw" in reported["names"]
    assert any("hinge01" in line for line in reported["changed"])
    assert any("<gazebo>" in line for line in reported["left_out"])


def test_an_existing_robot_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "worm.toml").write_text("mine")
    with raises_error(ConfigError, code="file/already-exists"):
        import_robot(SLIDER, ImportOptions(), tmp_path / "worm.toml")


def test_urdf_mesh_is_text_or_binary_and_missing_one_reported(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 2 0\n"
    )
    assert read_mesh_vertices(tmp_path / "a.stl").max(axis=0).tolist() == [1.0, 2.0, 0.0]
    assert read_mesh_vertices(HERE / "meshes" / "segment.stl").max(axis=0) == pytest.approx(
        [90.0, 32.0, 32.0]
    )
    (tmp_path / "b.stl").write_bytes(b"solid\nvertex a b c\n")
    with raises_error(ConfigError, code="urdf/invalid"):
        read_mesh_vertices(tmp_path / "b.stl")
    (tmp_path / "far.urdf").write_text(SLIDER.read_text())
    assert (
        "mesh 'package://slider_description/meshes/head.obj' left out: not on this computer"
        in "\n".join(import_urdf(tmp_path / "far.urdf", ImportOptions()).left_out)
    )


def test_a_document_that_shows_a_robot_shows_one_that_runs(tmp_path: Path) -> None:
    document = (Path(__file__).parents[4] / "docs" / "how-to" / "robots.md").read_text(
        encoding="utf-8"
    )
    robot = tmp_path / "eel.toml"
    robot.write_text(document.partition("```toml eel.toml\n")[2].partition("```")[0])
    result = simulate(config("peg_row", robot, "duration_s=3"))
    assert result.summary.ended == "complete"
    assert (result.summary.path_distance_m or 0.0) > 0.05
