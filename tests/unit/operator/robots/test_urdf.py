"""Exports robot files to URDF and back, imports foreign URDFs, and compares with MuJoCo's own URDF importer."""

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

URDF_DIR = Path(__file__).parent / "urdf"
SLIDER = URDF_DIR / "slider8.urdf"
HEXA = URDF_DIR / "hexa_snake_mm.urdf"
HEXA_OPTIONS = ImportOptions(scale=0.001, up="y")
# Without this element, MuJoCo merges fixed bodies and discards visual shapes.
MUJOCO_ELEMENT = (
    '<mujoco><compiler fusestatic="false" discardvisual="false" strippath="true" meshdir="{}"/>'
    "</mujoco></robot>"
)


def load_config(scenario: str, robot: Path, *set_options: str) -> RunConfig:
    """Load a scenario with another robot and other values."""
    overrides = [KeyOverride("robot", str(robot), "--set"), *map(parse_set_option, set_options)]
    return load_scenario(scenario, overrides).config


def read_robot(name: str | Path) -> RobotFile:
    """Read a robot file by the name of a shipped robot or by its path."""
    return decode_table(read_table_with_base(str(name), "robots"), RobotFile)


def import_with_mujoco(text: str, meshes: Path = URDF_DIR) -> mujoco.MjModel:
    """Return the model that MuJoCo's own importer makes of a URDF."""
    return mujoco.MjModel.from_xml_string(text.replace("</robot>", MUJOCO_ELEMENT.format(meshes)))


def compute_hinge_inertia(model: mujoco.MjModel) -> np.ndarray:
    """Return the inertia matrix of the hinges at zero angles, without rotors, (n_joints, n_joints)."""
    model.dof_armature[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))  # of all degrees of freedom
    mujoco.mj_fullM(model, data, inertia)
    hinges = [
        model.jnt_dofadr[i]
        for i in range(model.njnt)
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE
    ]
    return inertia[np.ix_(hinges, hinges)]


def build_imported_model(result: ImportResult, tmp_path: Path) -> mujoco.MjModel:
    """Return the model that the simulator builds of an imported robot."""
    path = tmp_path / "robot.toml"
    path.write_text(format_toml(result.table.values, []))
    return build_model(path)


def build_model(robot: Path) -> mujoco.MjModel:
    """Return the model that the simulator builds of a robot that is far from all obstacles."""
    config = load_config("peg_row", robot, "start.on_route=false", "start.position_m=[-9.0, 9.0]")
    return build_sim_model(config, SimSettings()).model


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_urdf_round_trip_keeps_every_shipped_robot(name: str, tmp_path: Path) -> None:
    exported = tmp_path / "robot.urdf"
    reimported = tmp_path / "robot.toml"
    export_robot(name, exported)
    import_robot(exported, ImportOptions(), reimported)
    assert read_robot(reimported) == read_robot(name)


def test_urdf_round_trip_keeps_limits_and_friction_of_each_joint(tmp_path: Path) -> None:
    original = tmp_path / "own.toml"
    exported = tmp_path / "own.urdf"
    reimported = tmp_path / "back.toml"
    edited = tmp_path / "edited.urdf"
    original.write_text(
        'extends = "planar13"\nname = "own"\n[drive]\ngear = 1.5\n'
        "[joints.joint_2]\nsign = -1\nzero_rad = 0.3\nangle_min_rad = -0.4\nspeed_rad_s = 3.0\n"
        "[joints.joint_5]\nangle_rad = 0.8\ntorque_nm = 2.5\nfriction_nm = 0.1\nvoltage_v = 22.0\n"
    )
    export_robot(str(original), exported)
    import_robot(exported, ImportOptions(), reimported)
    robot = read_robot(original)
    assert read_robot(reimported) == robot
    mujoco_model = import_with_mujoco(format_urdf(robot))
    assert mujoco_model.joint("joint_2").range == pytest.approx([-0.4, 1.5708])
    assert mujoco_model.joint("joint_5").range == pytest.approx([-0.8, 0.8])
    assert mujoco_model.joint("joint_5").frictionloss[0] == 0.1
    assert mujoco_model.joint("joint_4").frictionloss[0] == 0.0
    text = exported.read_text()
    assert text.count('lower="-0.4"') == 1
    edited.write_text(text.replace('lower="-0.4"', 'lower="-0.7"'))
    result = import_urdf(edited, ImportOptions())
    assert result.robot.joint_table[1].limits.lower_rad == -0.7, "a change in the URDF is imported"
    change = "angle_min_rad differs from that of the others: joint_2 (joint_2) -0.7 rad"
    assert change in result.changed


def test_urdf_import_has_exceptions_only_for_differing_joints() -> None:
    slider = import_urdf(SLIDER, ImportOptions()).robot
    hexa = import_urdf(HEXA, HEXA_OPTIONS).robot
    assert slider.limits.torque_nm == 4.1
    assert len(slider.joints) == 1
    assert [joint.limits.torque_nm for joint in slider.joint_table].count(3.8) == 1
    limits_rad = [(joint.limits.lower_rad, joint.limits.upper_rad) for joint in hexa.joint_table]
    expected_rad = [(-1.5, 1.5), (-1.4, 1.6), *[(-1.5, 1.5)] * 4]
    assert limits_rad == expected_rad, "the import negates the angle of the second joint"


@pytest.mark.parametrize("name", list_shipped_names("robots"))
def test_urdf_export_in_mujoco_has_same_bodies_joints_and_shapes(name: str) -> None:
    robot = read_robot(name)
    exported = import_with_mujoco(format_urdf(robot))
    simulated = build_model(Path(name))
    np.testing.assert_allclose(
        compute_hinge_inertia(exported), compute_hinge_inertia(simulated), rtol=1e-6, atol=1e-9
    )
    for i in range(robot.chain.modules + 1):
        exported_link = exported.body(f"link_{i}")
        simulated_link = simulated.body(f"link_{i}")
        np.testing.assert_allclose(
            [exported_link.mass[0], *np.sort(exported_link.inertia)],
            [simulated_link.mass[0], *np.sort(simulated_link.inertia)],
            rtol=1e-6,
        )
        np.testing.assert_allclose(exported_link.ipos, simulated_link.ipos, atol=1e-9)
        sizes = [
            exported.geom_size[geom]
            for geom in range(exported.ngeom)
            if exported.geom_bodyid[geom] == exported_link.id
        ]
        capsule = simulated.geom(f"link_{i}").size
        assert {tuple(size[:1]) for size in sizes} == {(capsule[0],)}
        assert max(size[1] for size in sizes) == pytest.approx(capsule[1])
    for i, axis in enumerate(robot.axes):
        joint = exported.joint(f"joint_{i + 1}")
        assert joint.axis.tolist() == ([0, 0, 1] if axis == "yaw" else [0, 1, 0])
        limits = robot.joint_table[i].limits
        assert joint.range == pytest.approx([limits.lower_rad, limits.upper_rad])


def test_urdf_import_planar_snake_has_inertia_of_mujoco(tmp_path: Path) -> None:
    result = import_urdf(SLIDER, ImportOptions())
    mujoco_model = import_with_mujoco(SLIDER.read_text(), URDF_DIR / "meshes")
    signs = np.array(
        [-1.0 if "hinge0" in name and "negated" in name else 1.0 for name in result.names[9:]]
    )
    np.testing.assert_allclose(
        compute_hinge_inertia(build_imported_model(result, tmp_path)),
        compute_hinge_inertia(mujoco_model) * np.outer(signs, signs),
        rtol=1e-6,
    )
    assert result.robot.module.radius_m == pytest.approx(np.hypot(0.015, 0.03)), (
        "the radius follows from the boxes of the covers"
    )


def test_urdf_import_alternating_millimeter_snake_has_inertia_of_mujoco(tmp_path: Path) -> None:
    text = HEXA.read_text().replace('ixx="0" iyy="0" izz="0"', 'ixx="110" iyy="120" izz="50"')
    path = tmp_path / "whole.urdf"
    path.write_text(text)
    result = import_urdf(path, HEXA_OPTIONS)
    assert result.robot.axes == ["yaw", "pitch"] * 3
    signs = np.array([-1.0 if "negated" in name else 1.0 for name in result.names[7:]])
    inertia_in_mm = compute_hinge_inertia(import_with_mujoco(text))
    np.testing.assert_allclose(
        compute_hinge_inertia(build_imported_model(result, tmp_path)),
        inertia_in_mm * 1e-6 * np.outer(signs, signs),
        rtol=1e-6,
        atol=1e-12,
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "options", "scenario", "controller"),
    [
        (SLIDER, ImportOptions(tail="seg08"), "peg_row", "obstacle_triplet"),
        (HEXA, HEXA_OPTIONS, "mamba_hills", "lateral_undulation"),
    ],
)
def test_urdf_import_of_foreign_snakes_can_run(
    file: Path, options: ImportOptions, scenario: str, controller: str, tmp_path: Path
) -> None:
    robot = tmp_path / "robot.toml"
    import_robot(file, options, robot)
    result = simulate(load_config(scenario, robot, f"controller={controller}", "duration_s=2"))
    assert result.summary.ended == "complete"
    assert np.abs(np.diff(result.record.angle_rad, axis=0)).max() > 1e-3, "its joints move"
    exported = tmp_path / "again.urdf"
    reimported = tmp_path / "again.toml"
    export_robot(str(robot), exported)
    import_robot(exported, ImportOptions(), reimported)
    assert read_robot(reimported) == read_robot(robot)


def test_urdf_import_names_values_it_cannot_express() -> None:
    slider = import_urdf(SLIDER, ImportOptions())
    hexa = import_urdf(HEXA, HEXA_OPTIONS)
    left_out = "\n".join(slider.left_out + hexa.left_out)
    changed = "\n".join(slider.changed + hexa.changed)
    for text in (
        "<transmission> left out: lines 26, 41",
        "<gazebo><plugin>",
        "<safety_controller>",
        "sensor 'nose' is rolled",
    ):
        assert text in left_out
    for text in (
        "hinge02",
        "continuous",
        "torque_nm differs from that of the others: joint_",
        ") 3.8 N·m",
        "link_3 has an inertia that no body has",
        # The URDF has -1.6 to 1.4 rad, which the import negates.
        "angle_max_rad differs from that of the others: joint_2 (b_c) 1.6 rad",
    ):
        assert text in changed
    assert hexa.robot.sensors.depth[0].position_m == pytest.approx((0.07, 0.0, 0.0))
    assert hexa.robot.sensors.imu is not None


HINGE = '<axis xyz="0 0 1"/><limit lower="-1" upper="1"/>'
TWO_JOINTS = f"""<robot name="two"><link name="a"/><link name="b"/><link name="c"/>
<joint name="j1" type="revolute"><parent link="a"/><child link="b"/>{HINGE}</joint>
<joint name="j2" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0.1 0 0"/>{HINGE}</joint></robot>"""
# A joint that connects the head with the tail.
CLOSING_JOINT = '<link name="r"/><joint name="j3" type="fixed"><parent link="c"/><child link="a"/></joint></robot>'
INVALID_URDFS = {
    "entities": '<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>',
    "not XML": "<robot>",
    "xacro": '<robot name="r" xmlns:xacro="x"><xacro:include filename="a"/></robot>',
    "deep": "<a>" * 40 + "</a>" * 40,
    "SDF": "<sdf/>",
    "a slider": TWO_JOINTS.replace('"revolute"', '"prismatic"', 1),
    "a fork": TWO_JOINTS.replace('link="b"/><child link="c"', 'link="a"/><child link="c"'),
    "a circle": TWO_JOINTS.replace("</robot>", CLOSING_JOINT),
    "no such link": TWO_JOINTS.replace('child link="c"', 'child link="d"'),
    "oblique": TWO_JOINTS.replace('"0 0 1"', '"0 1 1"', 1),
    "mimic": TWO_JOINTS.replace("<limit", '<mimic joint="j2"/><limit', 1),
    "no limits": TWO_JOINTS.replace('<limit lower="-1" upper="1"/>', "", 1),
    "a stop at zero": TWO_JOINTS.replace('lower="-1"', 'lower="0"', 1),
    "not a number": TWO_JOINTS.replace('"0.1 0 0"', '"nan 0 0"'),
    "in millimetres": TWO_JOINTS.replace('"0.1 0 0"', '"110 0 0"'),
}


@pytest.mark.parametrize("case", INVALID_URDFS)
def test_urdf_import_of_other_robot_is_refused_with_place(case: str, tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(INVALID_URDFS[case])
    with raises_error(ConfigError, code="urdf/invalid"):
        import_urdf(file, ImportOptions())


def test_urdf_import_report_is_available_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "a.toml")
    arguments = ["robot", "import", str(SLIDER), "--out", path, "--tail", "seg08", "--json"]
    assert main(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["file"] == path
    assert "joint_1: hinge08 (line 122), yaw" in report["names"]
    assert any("hinge01" in line for line in report["changed"])
    assert any("<gazebo>" in line for line in report["left_out"])


def test_urdf_import_never_overwrites_a_robot_file(tmp_path: Path) -> None:
    (tmp_path / "worm.toml").write_text("mine")
    with raises_error(ConfigError, code="file/already-exists"):
        import_robot(SLIDER, ImportOptions(), tmp_path / "worm.toml")


def test_urdf_mesh_is_text_or_binary_and_missing_one_reported(tmp_path: Path) -> None:
    (tmp_path / "a.stl").write_text(
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 2 0\n"
    )
    assert read_mesh_vertices(tmp_path / "a.stl").max(axis=0).tolist() == [1.0, 2.0, 0.0]
    assert read_mesh_vertices(URDF_DIR / "meshes" / "segment.stl").max(axis=0) == pytest.approx(
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


def test_robot_file_of_documentation_can_run(tmp_path: Path) -> None:
    page = Path(__file__).parents[4] / "docs" / "how-to" / "robots.md"
    document = page.read_text(encoding="utf-8")
    robot = tmp_path / "eel.toml"
    robot.write_text(document.partition("```toml eel.toml\n")[2].partition("```")[0])
    result = simulate(load_config("peg_row", robot, "duration_s=3"))
    assert result.summary.ended == "complete"
    assert (result.summary.path_distance_m or 0.0) > 0.05
