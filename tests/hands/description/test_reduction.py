"""The reduction of a description to the hand, and the repairs of descriptions that MuJoCo refuses."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from dro_grasp.errors import HandError
from dro_grasp.hands.description.compiling import LEAST_MASS, Note, compile_hand
from dro_grasp.hands.description.reduction import CONTINUOUS_LIMIT, keep_hand_only

FINGER = "<body name='finger'><joint name='bend' axis='0 1 0'/><geom size='.01'/></body>"
PATH = Path("scene.xml")


def reduced(world: str) -> tuple[mujoco.MjSpec, tuple[Note, ...]]:
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
    return spec, keep_hand_only(spec, PATH)


def test_the_hand_alone_is_left_at_the_origin() -> None:
    spec, notes = reduced("<geom type='plane' size='1 1 1'/><light/><body name='table'><geom size='.1'/></body>"
                          f"<body name='palm' pos='1 2 3' euler='90 0 0'><freejoint/><geom size='.02'/>{FINGER}</body>")
    model = spec.compile()
    assert [model.body(b).name for b in range(model.nbody)] == ["world", "palm", "finger"]
    assert (model.njnt, model.nlight, model.ngeom) == (1, 0, 2)
    assert model.body("palm").pos.tolist() == [0, 0, 0]
    assert model.body("palm").quat.tolist() == [1, 0, 0, 0]
    assert model.jnt_range[0].tolist() == pytest.approx([-CONTINUOUS_LIMIT, CONTINUOUS_LIMIT])
    assert {note.subject for note in notes} == {"table", "bend"}


def tree(name: str, *joints: str) -> str:
    """A body of the world on which one hangs for each joint."""
    return f"<body name='{name}'><geom size='.02'/>" + "".join(
        f"<body name='{joint}_link'><joint name='{joint}'/><geom size='.01'/></body>" for joint in joints) + "</body>"


@pytest.mark.parametrize("other", [("c", "d"), ("drawer_1", "drawer_2", "drawer_3")])
def test_two_trees_that_move_in_branches_are_told(other: tuple[str, ...]) -> None:
    """A second hand, or a cabinet with more joints."""
    with pytest.raises(HandError, match=r"has 2 trees of bodies.*: scene\.xml#one, scene\.xml#two$"):
        reduced(tree("one", "a", "b") + tree("two", *other))


def test_a_hand_branches_although_something_else_has_more_joints() -> None:
    lamp = tree("lamp", "first").replace("</body></body>", "<body><joint/><geom size='.1'/><body><joint/><geom size='.1'/>")
    spec, _ = reduced(lamp + "</body>" * 4 + tree("palm", "a", "b"))
    assert [body.name for body in spec.bodies] == ["world", "palm", "a_link", "b_link"]


def test_links_without_mass_get_some() -> None:
    spec, _ = reduced("<body name='palm'><geom size='.02'/><body name='finger'><joint name='bend'/></body></body>")
    with pytest.raises(ValueError, match="mass"):
        spec.copy().compile()
    notes: list[Note] = []
    model = compile_hand(spec, PATH, notes)
    assert model.body("finger").mass[0] == pytest.approx(LEAST_MASS)
    assert [note.subject for note in notes] == ["mass"]


def test_a_negative_mass_is_told_and_replaced() -> None:
    spec, _ = reduced("<body name='palm'><geom size='.02'/><body name='finger'><inertial pos='0 0 0' mass='-1' "
                      "diaginertia='1 1 1'/><joint name='bend'/><geom size='.01'/></body></body>")
    notes: list[Note] = []
    assert compile_hand(spec, PATH, notes).body("finger").mass[0] == pytest.approx(LEAST_MASS)
    assert [(note.subject, note.text.split(";")[0]) for note in notes] == [("finger", "states a mass of -1 kg")]


def test_names_that_a_file_leaves_out_are_told() -> None:
    _, notes = reduced("<body name='link_1'><geom size='.02'/><body><joint range='0 1'/><geom size='.01'/></body></body>")
    assert [note.subject for note in notes if "has no name" in note.text] == ["link_1_", "joint_0"]


def test_a_ball_joint_becomes_three_hinges() -> None:
    finger = FINGER.replace("<joint name='bend' axis='0 1 0'", "<joint name='bend' type='ball'")
    spec, notes = reduced(f"<body name='palm'><geom size='.02'/>{finger}</body>")
    assert [joint.name for joint in spec.joints] == ["bend_x", "bend_y", "bend_z"]
    assert [note.text for note in notes] == ["is a ball joint, taken as three hinges, bend_x, bend_y, bend_z"]
