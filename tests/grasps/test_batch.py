"""Grasp batches: selection, joining, and what they refuse."""

from __future__ import annotations

from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dro_grasp.errors import GraspFileError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import rows_at
from tests.helpers.claw import ball
from tests.helpers.tiny_bundle import made_up_grasps
from tests.helpers.toy_batches import BALL, CUBE, HAND, evaluated, make
from tests.helpers.toy_hand import toy_hand

MASK = torch.tensor([True, False, True, False, False])


@pytest.mark.parametrize("index", [1, -1, slice(1, 4, 2), [3, 0], [], MASK, [True, False, False, False, True], torch.tensor(2)])
def test_selection_agrees_between_tensors_and_tuples(index):
    grasps = evaluated(5).replace(extra={"row": torch.arange(5), "text": list("abcde")})
    chosen = grasps[index]
    assert chosen.extra["row"].tolist() == torch.arange(5)[index if index != [] else slice(0)].reshape(-1).tolist()
    for place, row in enumerate(chosen.extra["row"].tolist()):
        assert torch.equal(chosen.joints[place], grasps.joints[row])
        assert chosen.extra["text"][place] == "abcde"[row]
        assert chosen.success[place] == grasps.success[row]


def test_iterating_ends_and_out_of_range_is_an_index_error():
    grasps = make(3)
    singles = list(grasps)
    assert [len(single) for single in singles] == [1, 1, 1]
    assert torch.equal(torch.cat([single.joints for single in singles]), grasps.joints)
    with pytest.raises(IndexError):
        make(3)[3]


@pytest.mark.parametrize("cut", [slice(None, None, -1), slice(4, 1, -2), slice(-2, None), slice(9, 12)])
def test_slices_are_those_of_lists(cut):
    grasps = evaluated(5).replace(extra={"row": torch.arange(5)})
    assert grasps[cut].extra["row"].tolist() == list(range(5))[cut]


@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_parts_join_to_the_whole(size):
    whole = make(5)
    parts = list(whole.in_parts(size))
    assert [len(p) for p in parts] == [min(size, 5 - i) for i in range(0, 5, size)]
    joined = GraspBatch.concatenate(parts)
    assert torch.equal(joined.joints, whole.joints)
    assert joined.object == whole.object
    assert list(whole[0:0].in_parts(size)) == []


def test_joining_other_hands_is_refused():
    with pytest.raises(ValueError, match="cannot join"):
        GraspBatch.concatenate([make(1), make(1).replace(hand="other", hand_sha256="f" * 64)])


def test_sorting_puts_the_best_first_and_the_unscored_last():
    grasps = make(4, score=torch.tensor([0.1, torch.nan, 0.5, 0.1])).replace(extra={"row": torch.arange(4)})
    assert grasps.sorted_by_score().extra["row"].tolist() == [2, 0, 3, 1]


def test_sorting_by_energy_puts_the_lowest_first_and_the_unknown_last():
    energies = make(4, energy=torch.tensor([0.1, torch.nan, 0.5, 0.1])).replace(extra={"row": torch.arange(4)})
    assert energies.sorted_by_energy().extra["row"].tolist() == [0, 3, 2, 1]


def test_every_column_exists_and_says_what_is_unknown():
    grasps = make(3)
    for name in ("score", "energy", "displacement", "rotation", "penetration"):
        assert getattr(grasps, name).isnan().tolist() == [True] * 3, name
    for name in ("pregrasp_joints", "squeeze_joints"):
        assert getattr(grasps, name).isnan().sum() == grasps.joints.numel(), name
    assert not (grasps.trial_success | grasps.evaluated).any()
    assert grasps.protocol == ("",) * 3


def test_a_success_without_a_trial_and_columns_that_cannot_be_left_out_are_refused():
    with pytest.raises(ValueError, match="name the protocol"):
        make(2).replace(success=torch.tensor([True, False]))
    with pytest.raises(ValueError, match="names of fields"):
        make(2).replace(extra={"energy": torch.zeros(2)})
    for name in ("joints", "success", "typo"):
        with pytest.raises(ValueError, match=name):
            make(2).without(name)
    assert make(2, success=torch.tensor([True, False])).protocol == ("unknown",) * 2


@pytest.mark.parametrize("ask", [
    lambda g: g[g.success], lambda g: g[~g.success], lambda g: g[g.success & g.evaluated], lambda g: g.success.numpy(),
    lambda g: int(g.success.sum())])
def test_whether_untried_grasps_hold_is_not_known_however_it_is_asked(ask):
    with pytest.raises(OptionError, match="have not been tried"):
        ask(make(3))
    ask(evaluated(3))
    ask(make(0))


def test_of_grasps_of_which_some_were_tried_the_others_did_not_hold():
    both = GraspBatch.concatenate([make(2), evaluated(3)])
    assert both.success.tolist() == [False, False, True, False, True]
    with pytest.raises(ValueError, match="'success'"):
        both.replace(extra={"success": torch.zeros(5)})
    with pytest.raises(ValueError, match="wrist_position"):
        both.replace(extra={"wrist_position": torch.zeros(5, 3)})


@pytest.mark.parametrize("index", [True, False, np.True_, torch.tensor(True), 1.0, [0.5], "1", None, [[True, False, True]]])
def test_what_chooses_no_grasps_is_refused(index):
    with pytest.raises(OptionError, match="chooses no grasps"):
        rows_at(index, 3)


@pytest.mark.parametrize("index", [3, -4, np.int64(3), [0, 3], [True, False], torch.tensor([True] * 4)])
def test_grasps_that_do_not_exist_are_an_index_error(index):
    with pytest.raises(IndexError, match="batch of 3"):
        rows_at(index, 3)


def test_a_single_truth_value_is_no_grasp():
    with pytest.raises(OptionError, match="True chooses no grasps"):
        make(3)[True]


@pytest.mark.parametrize(("count", "subject"), [
    (1, "grasp 1 has"), (2, "grasp 1 and 1 more have"), (3, "grasp 1 and 2 more have")])
def test_how_many_poses_are_wrong_is_said_in_english(count, subject):
    given = make(4)
    T, joints = given.T_object_wrist.clone(), given.joints.clone()
    joints[1 : 1 + count, 0] = torch.nan
    with pytest.raises(OptionError, match=f"^{subject} a pose or joints that are not finite"):
        GraspBatch.create(HAND, BALL, T, joints)
    T[1 : 1 + count, :3, :3] *= 2
    with pytest.raises(OptionError, match=f"^{subject} a wrist pose that is no rigid motion"):
        GraspBatch.create(HAND, BALL, T, given.joints)


def test_leaving_out_a_trial_leaves_the_rest():
    grasps = evaluated(4, score=torch.rand(4)).replace(extra={"reason": ["slipped by 30 mm"] * 4, "depth": torch.rand(4)})
    again = grasps.without_trial()
    assert not again.evaluated.any()
    assert again.penetration.isnan().all()
    assert list(again.extra) == ["depth"]
    assert torch.equal(again.score, grasps.score)
    assert list(grasps.without("score", "depth").extra) == ["reason"]


def test_moved_grasps_keep_nothing_of_the_poses_before():
    numbers, joints = torch.rand(4), torch.rand(4, 2)
    outcome = evaluated(4, score=numbers, energy=numbers, pregrasp_joints=joints, squeeze_joints=joints)
    before = outcome.replace(extra=outcome.extra | {
        "depth": torch.rand(4), "energy_contact": torch.rand(4), "object_file": ("ball.stl",) * 4})
    moved = before.with_poses(before.T_object_wrist.flip(0), before.joints + 1)
    assert torch.equal(moved.joints, before.joints + 1)
    assert torch.equal(moved.T_object_wrist, before.T_object_wrist.flip(0))
    for name in ("score", "energy", "pregrasp_joints", "squeeze_joints", "displacement", "rotation", "penetration"):
        assert getattr(moved, name).isnan().all(), name
    assert not moved.evaluated.any()
    assert list(moved.extra) == ["object_file"]
    assert (moved.object, moved.provenance) == (before.object, before.provenance)


def test_grasps_come_apart_by_object_in_their_order():
    mixed = GraspBatch.concatenate([make(1, obj=CUBE, seed=1), make(2, seed=2), make(1, obj=CUBE, seed=3)])
    assert [(name, part.object, part.seed.tolist()) for name, part in mixed.by_object()] == [
        ("cube", ("cube",) * 2, [1, 3]), ("ball", ("ball",) * 2, [2, 2])]
    assert list(make(0).by_object()) == []


def test_objects_of_one_name_come_apart_by_their_hashes():
    other, third = (SimpleNamespace(name="ball", sha256=h * 64, split=None) for h in "de")
    named = SimpleNamespace(name="ball (2)", sha256="f" * 64, split=None)
    unknown = SimpleNamespace(name="ball", sha256="", split=None)
    mixed = GraspBatch.concatenate([
        make(1, obj=obj, seed=i) for i, obj in enumerate((unknown, BALL, other, named, third, BALL, other))])
    assert [(label, part.seed.tolist()) for label, part in mixed.by_object()] == [
        ("ball", [0, 1, 5]), ("ball (3)", [2, 6]), ("ball (2)", [3]), ("ball (4)", [4])]
    assert [label for label, _ in make(2, obj=unknown).by_object()] == ["ball"]


def test_closing_is_stated_by_a_pregrasp_and_a_squeeze():
    rows = torch.zeros(4, 2)
    pregrasps, squeezes = rows.clone(), rows.clone()
    pregrasps[[1, 3], 0], squeezes[[2, 3], 1] = torch.nan, torch.nan
    assert make(4, pregrasp_joints=pregrasps, squeeze_joints=squeezes).states_closing.tolist() == [True, False, False, False]
    assert not make(1).states_closing.any()


def test_a_batch_says_what_it_holds():
    grasps = GraspBatch.concatenate([evaluated(4, score=torch.tensor([1.0, 0.5, -2.0, 0.0])), make(1, obj=CUBE)])
    assert repr(grasps) == ("GraspBatch(5 grasps, hand 'toy', objects 'ball', 'cube', 2 of 4 hold under dro/1, "
                            "1 not evaluated, score -2.00 to 1.00)")
    assert "not evaluated" in repr(make(2))
    assert repr(make(0)) == "GraspBatch(0 grasps, hand 'toy')"
    page = grasps.replace(hand="<b>")._repr_html_()
    assert page.count("<tr>") == 6
    assert "&lt;b&gt;" in page
    assert "slipped by 30 mm" in page


def test_pandas_sees_the_columns():
    pytest.importorskip("pandas")
    frame = evaluated(3).to_pandas()
    assert len(frame) == 3
    assert set(frame["object"]) == {"ball"}
    assert frame["success"].tolist() == [True, False, True]


def test_without_pandas_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(OptionError, match="pip install pandas"):
        make(1).to_pandas()


def test_unequal_columns_are_refused():
    with pytest.raises(ValueError, match="other lengths"):
        make(3).replace(extra={"wrench": torch.zeros(2)})


def test_another_hand_is_refused():
    tree = SimpleNamespace(link_names=("base",), joint_names=("k",))
    other = SimpleNamespace(name="x", sha256="", tree=tree)
    with pytest.raises(GraspFileError, match="toy"):
        make(1).require_hand(other)


def test_poses_and_joints_may_be_arrays_of_any_precision():
    hand, obj = toy_hand(), ball()
    given = made_up_grasps(hand, count=3)
    made = GraspBatch.create(hand, obj, given.T_object_wrist.double().numpy(), given.joints.double().numpy(), seed=1)
    assert made.joints.dtype == made.T_object_wrist.dtype == torch.float32
    assert torch.equal(made.joints, given.joints)
    assert made.seed.tolist() == [1, 1, 1]


def test_every_column_may_be_an_array_of_any_precision():
    hand, obj = toy_hand(), ball()
    given = made_up_grasps(hand, count=3)
    q = given.joints.flip(0).double().numpy()[::-1]
    made = GraspBatch.create(
        hand, obj, given.T_object_wrist.flip(0).numpy()[::-1], q, pregrasp_joints=q - 1, squeeze_joints=(q + 1).tolist(),
        score=np.array([1, 3, 2]), energy=np.arange(3.0), success=np.array([1, 0, 1]), seed=np.array([7, 8, 9], np.uint8),
        protocol=np.array(["dro/1"] * 3), extra={"depth": np.arange(3.0), "count": np.arange(3), "note": np.array(list("abc"))})
    assert "score 1.00 to 3.00" in repr(made)
    assert made.states_closing.tolist() == [True] * 3
    back = GraspBatch.load(BytesIO(made.sorted_by_score().to_bytes()))
    assert back.seed.tolist() == [8, 9, 7]
    assert back.success.tolist() == [False, True, True]
    assert back.protocol == ("dro/1",) * 3
    torch.testing.assert_close(back.pregrasp_joints, given.joints[[1, 2, 0]] - 1)
    torch.testing.assert_close(back.squeeze_joints, given.joints[[1, 2, 0]] + 1)
    assert back.extra["note"] == ["b", "c", "a"]
    assert back.extra["depth"].tolist() == back.extra["count"].tolist() == [1, 2, 0]
    assert back.energy.dtype == made.extra["depth"].dtype == torch.float32
    assert GraspBatch.create(hand, obj, given.T_object_wrist, q, seed=np.int64(5)).seed.tolist() == [5, 5, 5]


@pytest.mark.parametrize(("column", "told"), [
    ({"pregrasp_joints": np.zeros((3, 1))}, r"pregrasp_joints has shape \(3, 1\); expected \(3, 2\)"),
    ({"score": np.zeros((3, 1))}, r"score has shape \(3, 1\); expected \(3,\)"),
    ({"scores": [1.0, 2.0, 3.0]}, "no column 'scores'; they have .*success, .*score, .*, and in extra"),
    ({"seed": 1.5}, "seed is no array of numbers .it has fractions."), ({"seed": "0"}, "seed is no array of numbers"),
    ({"success": [0.5, 1.0, 0.0]}, "success is no array of numbers .it has fractions."),
    ({"score": ["1", "2", "3"]}, "score is no array of numbers"),
    ({"protocol": "strict/1"}, "protocol is 'strict/1'; give one text for each of the 3 grasps"),
    ({"protocol": ["strict/1"] * 2}, "protocol has 2 texts; give one for each of the 3 grasps"),
    ({"split": [1, 2, 3]}, "split is .*; give one text"),
    ({"success": True}, r"success has shape \(\); expected \(3,\)"),
    ({"seed": [1, 2]}, r"seed has shape \(2,\); expected \(3,\)"),
    ({"energy": ["low"] * 3}, "energy is no array of numbers"),
])
def test_columns_that_do_not_fit_are_refused(column, told):
    with pytest.raises(OptionError, match=told):
        GraspBatch.create(HAND, BALL, torch.eye(4).repeat(3, 1, 1), torch.zeros(3, 2), **column)


@pytest.mark.parametrize(("change", "told"), [
    (lambda T, q: (T[:, :3, :3], q), r"poses of shape \(3, 3, 3\).*expected \(n, 4, 4\)"),
    (lambda T, q: (T, q[:, 1:]), r"joints of shape \(3, 5\).*\(n, 6\) for this hand"),
    (lambda T, q: (T * torch.tensor([2.0, 2, 2, 1]), q), "grasp 0 and 2 more have a wrist pose that is no rigid motion"),
    (lambda T, q: (T * torch.tensor([-1.0, 1, 1, 1]), q), "grasp 0 and 2 more have a wrist pose that is no rigid motion"),
    (lambda T, q: ([[1.0], [2.0, 3.0]], q), "no arrays of numbers"),
    (lambda T, q: (T, torch.full_like(q, torch.nan)), "grasp 0 and 2 more have a pose or joints that are not finite"),
])
def test_poses_and_joints_that_are_none_are_refused(change, told):
    given = made_up_grasps(toy_hand(), count=3)
    with pytest.raises(OptionError, match=told):
        GraspBatch.create(toy_hand(), ball(), *change(given.T_object_wrist, given.joints))


def test_a_further_column_of_three_axes_is_refused() -> None:
    with pytest.raises(ValueError, match=r"more than two axes: {'mine': \(2, 2, 3\)}"):
        make(2).replace(extra={"mine": torch.zeros(2, 2, 3)})


@pytest.mark.usefixtures("as_users_have_it")
@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.int16])
def test_indices_of_any_size_choose(kind: type) -> None:
    batch = make(2)
    assert torch.equal(batch[np.array([1, 0], kind)].joints, batch.joints.flip(0))


def test_poses_alone_have_no_trial() -> None:
    batch = evaluated(3, score=torch.rand(3))
    before = batch.poses_only()
    assert not before.evaluated.any()
    assert torch.equal(before.joints, batch.joints)


def test_other_poses_know_no_hold() -> None:
    batch = make(2).replace(extra={"held_joints": torch.zeros(2, 1), "q1": torch.ones(2), "mine": torch.ones(2)})
    assert set(batch.with_poses(batch.T_object_wrist, batch.joints).extra) == {"mine"}


@pytest.mark.parametrize(("name", "column", "told"), [
    ("frame", torch.arange(2), "'frame' holds int64, expected texts"),
    ("frame", ["a", "b"], "lacks the column 'T_frame_camera'"),
    ("object_mass", ["1", "2"], "'object_mass' holds .*string, expected numbers")])
def test_what_no_file_could_be_read_with_is_not_saved(name: str, column: object, told: str, tmp_path: Path) -> None:
    with pytest.raises(GraspFileError, match=f"what is to be saved.*{told}"):
        make(2).replace(extra={name: column}).save(tmp_path / "grasps.parquet")
    assert not (tmp_path / "grasps.parquet").exists()
