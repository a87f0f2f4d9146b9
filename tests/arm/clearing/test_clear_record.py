"""Runs that cleared a table, kept in a file: what comes back, what is refused, and what a rig's recorder notes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dro_grasp as dro
from dro_grasp.arm.clearing.loop import Bin, Pick
from dro_grasp.arm.clearing.record import ClearRecord, ClearRecorder, Judgement, Look, Picked, RecordedRig, is_record
from dro_grasp.arm.planning.motion import Trajectory
from dro_grasp.errors import PlanError
from dro_grasp.grasps.hold import HoldCheck

HELD = HoldCheck("held", 0.9, {"held": 0.9, "empty": 0.06, "slipping": 0.04})


@pytest.fixture
def recorder(robot: dro.Robot) -> ClearRecorder:
    """A look, three moments, a check, a pick, and a last look."""
    made = ClearRecorder(objects=(dro.load_object("can"),), fixtures=(Bin().walls(0.0),))
    made.looked(np.arange(12.0).reshape(4, 3))
    hand = robot.hand.canonical_joints().double().numpy()
    for k in range(3):
        T = np.eye(4)
        T[0, 3] = 0.1 * k
        made.frames.append((robot.home + 0.01 * k, hand, T[None]))
    made.judged(HELD, True)
    made.picked(Pick((0.5, 0.1), "done"))
    made.looked(np.zeros((0, 3)))
    return made


def test_a_record_comes_back_whole(recorder: ClearRecorder, robot: dro.Robot, tmp_path: Path) -> None:
    made = recorder.record(robot)
    made.save(tmp_path / "cleared.npz")
    assert is_record(tmp_path / "cleared.npz")
    back = ClearRecord.load(tmp_path / "cleared.npz")
    assert back.events == made.events == (
        Look(0, 0), Judgement(2, "held", 0.9, True), Picked(2, (0.5, 0.1), "done", ""), Look(2, 1))
    assert (back.robot, back.robot_sha256, back.rate, back.names) == (robot.name, robot.sha256, 10.0, ("can",))
    for one, other in ((back.arm, made.arm), (back.hand, made.hand), (back.poses, made.poses), *zip(
            back.clouds, made.clouds, strict=True), *zip(back.objects[0], made.objects[0], strict=True),
            *zip(back.fixtures[0], made.fixtures[0], strict=True)):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_record_keeps_a_point_of_each_cube_of_what_was_seen() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(4) * 0.003 + 0.001] * 3), -1).reshape(-1, 3)
    made = ClearRecorder()
    made.looked(np.concatenate([grid, grid + 0.0005, [[np.nan] * 3]]))
    np.testing.assert_array_equal(np.sort(made.clouds[0], 0), np.sort(grid, 0))


def test_what_is_no_record_is_refused(recorder: ClearRecorder, robot: dro.Robot, tmp_path: Path) -> None:
    path = tmp_path / "cleared.npz"
    recorder.record(robot).save(path)
    whole = path.read_bytes()
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    for changed in (header | {"format_version": 99}, header | {"kind": "plan"}):
        np.savez(path, **arrays | {"header": np.array(json.dumps(changed))})
        with pytest.raises(PlanError, match="no record of a cleared table, or one of another version"):
            ClearRecord.load(path)
    assert not is_record(path)
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(PlanError, match="a record of a cleared table"):
        ClearRecord.load(path)
    assert not is_record(path)
    assert not is_record(tmp_path / "none.npz")
    with pytest.raises(PlanError, match="nothing has moved"):
        ClearRecorder().record(robot)


def test_a_rig_of_ones_own_is_recorded(robot: dro.Robot) -> None:
    """Joints are those of the trajectory, by an interpolation of its samples."""
    class Rig:
        moved = 0

        def look(self) -> np.ndarray:
            return np.ones((2, 3))

        def move(self, arm: Trajectory, hand: Trajectory) -> None:
            self.moved += 1

        def joints(self) -> tuple[np.ndarray, np.ndarray]:
            return robot.home, robot.open_hand

    own, recorder = Rig(), ClearRecorder()
    rig, time = RecordedRig(own, recorder), np.linspace(0, 1, 5)
    way = robot.home + np.linspace(0, 0.2, 5)[:, None]
    still = np.tile(robot.open_hand, (5, 1))
    arm = Trajectory(time, way, 0 * way, 0 * way)
    assert len(rig.look()) == 2
    rig.move(arm, Trajectory(time, still, 0 * still, 0 * still))
    assert own.moved == 1
    assert rig.joints()[0] is robot.home
    watched = Trajectory(np.array([0.0, 0.01]), way[-2:], 0 * way[:2], 0 * way[:2])
    for _ in range(20):  # as the joints are watched
        rig.move(watched, Trajectory(watched.time, still[:2], 0 * still[:2], 0 * still[:2]))
    assert len(recorder.frames) == 12
    del recorder.frames[10:]
    recorder.picked(replace(Pick((0.5, 0.1), "lift"), reason="the hand is empty, by its joints"))
    record = recorder.record(robot)
    assert record.poses.shape == (10, 0, 4, 4)
    np.testing.assert_allclose(record.arm[:, 0], robot.home[0] + 0.2 * np.arange(10) / 10, atol=1e-9)
    assert record.events[-1] == Picked(9, (0.5, 0.1), "lift", "the hand is empty, by its joints")
