"""Constraints through the whole chain, checked by the collision shapes of the hand, which no stage reads."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from dro_grasp.errors import OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.objects.catalogue import load_object
from dro_grasp.objects.scenery import load_scene
from dro_grasp.optimize.starts import LARGEST_TILT, angle_to_arc
from dro_grasp.predict.admission import feasible
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.optimiser import OptimiserSource
from dro_grasp.predict.stages import refine
from tests.helpers.loaded_hands import loaded_hand

SOAP = load_object("soap")
"""4 cm high: no hand reaches around it on a table."""
TABLE = float(SOAP.cloud[:, 2].min())


def shapes(hand: Hand, T: Tensor, q: Tensor) -> Float[np.ndarray, "n 3"]:
    """Vertices of all colliding shapes of one posed hand [m]."""
    assert hand.description is not None
    poses = (T @ hand.tree.forward(q)).double().numpy()
    return np.concatenate([
        shape.vertices @ poses[shape.link, :3, :3].T + poses[shape.link, :3, 3]
        for shape in hand.description.geometry if shape.collides])


def postures(grasps: GraspBatch, row: int) -> list[Tensor]:
    """Pregrasp, grasp and squeeze of one grasp."""
    return [joints[row].float() for joints in (grasps.pregrasp_joints, grasps.joints, grasps.squeeze_joints)]


@pytest.mark.parametrize(("name", "direction"), [
    ("gripper3", (0.0, 0.0, -1.0)), pytest.param("allegro", (1.0, 0.0, 0.0), marks=pytest.mark.slow)])
def test_a_low_object_on_a_table_is_grasped(name: str, direction: tuple[float, float, float]) -> None:
    hand = loaded_hand(name)
    problem = GraspProblem(hand, SOAP, constraints=Constraints(direction, TABLE))
    found = refine(problem, OptimiserSource().propose(problem, 8, seed=0).grasps)
    kept = found[feasible(problem, found)]
    assert len(kept) >= 3
    off = angle_to_arc(hand.palm_directions(kept.T_object_wrist), torch.tensor(direction), torch.tensor([0.0, 0.0, 1.0]))
    assert float(torch.rad2deg(off).median()) < 30, "near the direction, or tilted from there to the table"
    for row in range(len(kept)):
        lowest = min(shapes(hand, kept.T_object_wrist[row].float(), q)[:, 2].min() for q in postures(kept, row))
        assert lowest > TABLE - 0.002, "surface points are sparse, but not that sparse [m]"
    free = GraspProblem(hand, SOAP, constraints=Constraints(direction))
    below = refine(free, OptimiserSource().propose(free, 8, seed=0).grasps)
    assert float(feasible(problem, below).float().mean()) < 0.2


def test_palms_tilt_only_towards_the_plane() -> None:
    up, side = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([1.0, 0.0, 0.0])

    def tilted(angle: float) -> Tensor:
        return torch.tensor([math.cos(angle), 0.0, -math.sin(angle)])

    palms = torch.stack([side, tilted(0.5), tilted(LARGEST_TILT + 0.2), tilted(-0.3), torch.tensor([0.0, 1.0, 0.0])])
    expected = torch.tensor([0.0, 0.0, 0.2, 0.3, math.pi / 2])
    torch.testing.assert_close(angle_to_arc(palms, side, up), expected, atol=1e-3, rtol=0)
    torch.testing.assert_close(angle_to_arc(palms[:2], side, None), torch.tensor([0.0, 0.5]), atol=1e-3, rtol=0)
    torch.testing.assert_close(angle_to_arc(palms[:1], -up, up), torch.tensor([math.pi / 2]), atol=1e-3, rtol=0)


def test_a_table_above_the_object_is_refused() -> None:
    with pytest.raises(OptionError, match="leaves nothing of the object, which ends at z"):
        GraspProblem(loaded_hand("gripper3"), SOAP, constraints=Constraints(table=0.1))
    with pytest.raises(OptionError, match="table is nan"):
        Constraints(table=math.nan)


def given(**values: object) -> Constraints:
    """Constraints as a user's program makes them, without the check of annotations that tests install."""
    made = object.__new__(Constraints)
    for field in dataclasses.fields(Constraints):
        object.__setattr__(made, field.name, values.get(field.name, field.default))
    made.__post_init__()
    return made


def test_vectors_of_any_kind_become_plain_numbers() -> None:
    plain = Constraints((0.0, 0.0, -1.0), contact_region=((0.0, 0.0, 0.1, 0.03),), keep_out=((0.1, 0.0, 0.0, 0.02),))
    for make in (np.array, torch.tensor, list):
        made = given(direction=make([0, 0, -1]), contact_region=make([[0.0, 0.0, 0.1, 0.03]]),
                     keep_out=make([[0.1, 0.0, 0.0, 0.02]]))
        numbers = [*made.direction, *(number for ball in (*made.contact_region, *made.keep_out) for number in ball)]
        assert all(type(number) is float for number in numbers)
        if make is not torch.tensor:  # which rounds to single precision
            assert repr(made) == repr(plain)
            assert made == plain
        assert made != Constraints()
        assert len({made, Constraints()}) == 2
    for nothing in ([], np.zeros((0, 4))):
        assert given(contact_region=nothing, keep_out=nothing) == Constraints()


@pytest.mark.parametrize("direction", [
    (0, -1), (0, 0, -1, 0), (), 3.0, "up", "001", ("0", "0", "1"), (0, 0, "x"), np.eye(3), torch.eye(3)])
def test_a_direction_that_is_no_vector_is_refused(direction: object) -> None:
    with pytest.raises(OptionError, match=r"direction is .*; give three numbers, .*direction=\(0, 0, -1\)"):
        given(direction=direction)


@pytest.mark.parametrize("direction", [(0, 0, 0), np.zeros(3), (0, math.nan, 1), torch.tensor([0, 0, math.inf])])
def test_a_vector_without_a_direction_is_refused(direction: object) -> None:
    with pytest.raises(OptionError, match=r"direction \(0.0, .* has no direction"):
        given(direction=direction)


@pytest.mark.parametrize("name", ["contact_region", "keep_out"])
@pytest.mark.parametrize("balls", [
    (0, 0, 0.1, 0.03), 1.0, np.zeros(4), [(0, 0, "x", 1)], ["ball"], ["0123"],
    [("0", "0", "0", "1")], [(0, 0, 0.1)], [(0, 0, math.nan, 1)], [(0, 0, 0, 0)]])
def test_balls_that_are_none_are_refused(name: str, balls: object) -> None:
    option = "--" + name.replace("_", "-")
    with pytest.raises(OptionError, match=f"{name} .*; give .*x, y, z and a radius above 0 in metres, .*{option} 0 0 0.1"):
        given(**{name: balls})


def test_every_field_moves_with_the_frame_or_is_the_same_in_all_of_them() -> None:
    """A field that is left out of `moved` would be judged in the wrong frame by `plan`."""
    everything = Constraints(
        direction=(1.0, 0.0, -1.0), table=-0.1, max_tilt=0.5, obstacles=load_scene(np.full((40, 3), 0.7)),
        contact_region=((0.0, 0.0, 0.0, 0.1),), keep_out=((0.1, 0.0, 0.0, 0.02),), pregrasp_clearance=0.01,
        touch_table=True, margin=2.0, max_force=5.0)
    assert all(getattr(everything, f.name) not in (None, ()) for f in dataclasses.fields(Constraints)), "each field is tried"
    T = np.eye(4)
    T[:2, :2], T[:3, 3] = [[0.0, -1.0], [1.0, 0.0]], (0.1, 0.2, 0.3)
    moved = everything.moved(T)
    same = {f.name for f in dataclasses.fields(Constraints) if getattr(moved, f.name) == getattr(everything, f.name)}
    assert same == {"max_tilt", "pregrasp_clearance", "touch_table", "margin", "max_force"}
