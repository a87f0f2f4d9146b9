"""The computing side of a grasp server: what it has loaded, and the answer to one request."""

from __future__ import annotations

import base64
import hashlib
import tempfile
import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cachetools import LRUCache
from jaxtyping import Float
from torch import Tensor

from dro_grasp.apps.library import Kind, Library, store_upload
from dro_grasp.apps.report import NO_TRIAL, doubt, protocol_for, require_trial, told_of
from dro_grasp.apps.server.messages import (
    GenerateAnswer,
    GenerateCall,
    GraspAnswer,
    SentCamera,
    SentGrasp,
    SentObject,
    settings_in,
)
from dro_grasp.errors import DroGraspError, HandError, ObjectError, OptionError
from dro_grasp.files import given_path
from dro_grasp.frames import NamedMotion, is_name, motion_fault
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.grasps.columns import REASON
from dro_grasp.grasps.forces import efforts_of, known, squeeze_efforts
from dro_grasp.grasps.sources import hand_file, object_file, recorded
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand
from dro_grasp.kinds import Checked
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.objects.loading import check_scale
from dro_grasp.objects.perception.scan import level_plane, load_scan, scanned_object
from dro_grasp.objects.perception.scene_files import SceneCamera
from dro_grasp.objects.scenery import FoundObject, Scene, load_scene
from dro_grasp.objects.shape import ObjectModel, with_mass
from dro_grasp.predict.config import GraspRequest
from dro_grasp.predict.constraints import Constraints
from dro_grasp.predict.predictor import GraspPredictor, Prediction
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.source import Progress
from dro_grasp.predict.stages import evaluate
from dro_grasp.simulation.protocols import protocol

MAX_PROBLEMS = 8  # Most pairs of hand and object, with constraints, of which all that was derived stays (ours)
MAX_CANDIDATES = 1_000  # Most candidates of one request (ours): a server answers robots, `generate` fills files


@dataclass(frozen=True)
class ServerConfig(Checked):
    """What a server computes with."""

    weights: str | None = None  # Name of shipped weights or path of a weights file; None takes the default
    device: str = "cpu"  # Where the network and the energies run
    hands: tuple[str, ...] = ()
    """Names or files of hands that are loaded before serving; built-in ones can be asked for besides."""
    objects: tuple[str, ...] = ()
    """Files and folders of objects that can be asked for by the names of the files; built-in ones can be besides."""


class Answerer:
    """Answers requests one by one, with hands and objects that stay loaded; nothing is read but what it was given and sent."""

    def __init__(self, config: ServerConfig) -> None:
        """Load the weights and the hands.

        Raises:
            DroGraspError: Something cannot be used, or two files of hands or of objects have one name.
        """
        self.library = Library()
        self._offer("object", [(Path(source).stem, source, source) for source in resolve_objects(list(config.objects))])
        hands = {source: load_hand(source) for source in config.hands}
        self._offer("hand", [(hand.name, source, hand) for source, hand in hands.items()])
        self.hand_files = {hand.name: hand_file(source) for source, hand in hands.items()}
        self.predictor = GraspPredictor(config.weights, config.device)
        self.problems: LRUCache[Hashable, GraspProblem] = LRUCache(MAX_PROBLEMS)

    def _offer(self, kind: Kind, named: Sequence[tuple[str, str, Any]]) -> None:
        """Let what lies in files be asked for: of each its name, the name or file given, and what the library takes."""
        first: dict[str, str] = {}
        for name, source, content in named:
            other = first.setdefault(name, source)
            if given_path(other).resolve() != given_path(source).resolve():
                raise OptionError(f"{kind}s '{other}' and '{source}' would both be asked for by the name '{name}'; rename one "
                                  "of the files, or leave one out")
            self.library.add(kind, name, content)

    def answer(self, call: Any, progress: Progress | None = None) -> GraspAnswer | GenerateAnswer:
        """The answer to a GraspCall or GenerateCall; `progress` is called now and then, and what it raises ends the work."""
        begin = time.perf_counter()
        request = settings_in(call, GraspRequest)
        if request.num * request.candidates > MAX_CANDIDATES:
            raise OptionError(f"{request.num} grasps of {request.candidates} candidates each are asked for; a server makes at "
                              f"most {MAX_CANDIDATES} candidates at once, `dro-grasp generate` more")
        problem = self.problem(call)
        if isinstance(call, GenerateCall):
            return self._generated(call, problem, request, time.perf_counter() - begin, progress)
        hand, obj = problem.hand, problem.obj
        if call.protocol is not None:
            protocol(call.protocol)  # an unknown one is refused before the work
            if obj.is_cloud:
                raise OptionError(f"protocol is '{call.protocol}', and a bare cloud gets no trial; send a mesh, or leave it "
                                  "out")
        if not obj.is_cloud:
            obj.cut(progress)
        loaded = time.perf_counter() - begin
        made = self.predictor.run(problem, request, progress)
        middle = time.perf_counter()
        grasps = made.grasps if call.protocol is None else evaluate(problem, made.grasps, call.protocol, progress)
        warning = problem.constraints.warning(obj)
        seconds = {"load": loaded, **made.seconds, "trial": time.perf_counter() - middle, "total": time.perf_counter() - begin}
        return GraspAnswer(
            id=call.id, hand=hand.name, object=obj.name, frame="object" if call.camera is None else call.camera.frame,
            wrist_link=grasps.wrist_link, joint_names=list(grasps.joint_names), grasps=sent_grasps(hand, grasps, made),
            candidates=made.candidates, weights=self.predictor.weights_name, protocol=call.protocol,
            notes=[*obj.notes, *filter(None, [warning])], shortage=made.shortage,
            seconds={name: round(value, 4) for name, value in seconds.items()})

    def _generated(
        self, call: Any, problem: GraspProblem, request: GraspRequest, loaded: float, progress: Progress | None
    ) -> GenerateAnswer:
        """What `dro-grasp generate` tells and saves of the pair."""
        hand, obj = problem.hand, problem.obj
        require_trial(obj, call.protocol, call.only_successful)
        if not obj.is_cloud:
            obj.cut(progress)
        made = self.predictor.run(problem, request, progress)
        begin, rules = time.perf_counter(), protocol_for(obj, call.protocol)
        own = self.library.own["object"].get(call.object.name or "")
        path = call.path if own is None else object_file(own)
        # The command's predictor records the file of an object that no camera saw, which has none here.
        grasps = recorded(made.grasps, None, None if call.camera else path, call.object.scale)
        grasps = grasps if rules == NO_TRIAL else evaluate(problem, grasps, rules, progress)
        trial = time.perf_counter() - begin if bool(grasps.evaluated.any()) else 0.0
        frame = "object" if call.camera is None else call.camera.frame
        told = told_of(obj, made, grasps, hand=hand.name, num=request.num, seed=request.seed,
                       weights=self.predictor.weights_name, protocol=rules, frame=frame)
        odd = [doubt(problem.constraints, obj, call.camera is not None), made.shortage]
        kept = grasps[grasps.success] if call.only_successful else grasps
        camera = None if call.camera is None else NamedMotion(call.camera.frame, sent_pose(call.camera).float())
        taken = None if call.choose is None else obj
        file = recorded(
            kept, self.hand_files.get(hand.name), None if taken else path, call.object.scale, camera, taken).to_bytes()
        text = base64.b64encode(file).decode()
        return GenerateAnswer(
            **told._asdict(), file=text, kept=len(kept), seconds={"load": loaded, **made.seconds, "trial": trial},
            warnings=[f"{obj.name}: {note}" for note in obj.notes] + [f"warning: {obj.name}: {why}" for why in odd if why])

    def problem(self, call: Any) -> GraspProblem:
        """The pair of a call, with its constraints; the last few are kept."""
        found = None if call.choose is None else self.chosen(call)
        obstacles = self.scene(call.obstacles, call.camera)
        if found is not None and found.obstacles is not None:
            obstacles = found.obstacles.joined(obstacles)
        constraints, hand = settings_in(call, Constraints, obstacles=obstacles), self.hand(call.hand)
        key, obj = self.object(call.object, call.camera, call.table) if found is None else (found.obj.sha256, found.obj)
        obj = obj if call.mass is None else with_mass(obj, call.mass)
        pair = hand.name, key, call.mass, constraints
        if (problem := self.problems.get(pair)) is None:
            problem = self.problems[pair] = GraspProblem(hand, obj, self.predictor.device, constraints)
        return problem

    def hand_names(self) -> list[str]:
        """Names of the hands that can be asked for."""
        return list(self.library.names("hand"))

    def object_names(self) -> list[str]:
        """Names of the objects that can be asked for."""
        return list(self.library.names("object"))

    def hand(self, name: str) -> Hand:
        """A hand by its name.

        Raises:
            HandError: The server knows no such hand.
        """
        if name not in (known := self.hand_names()):
            raise HandError(f"this server knows no hand '{name}'; it knows {', '.join(known)}. Start it with "
                            f"`dro-grasp serve --hand FILE` for another one")
        return self.library.hand(name)

    def object(
        self, sent: SentObject, camera: SentCamera | None, height: float | None = None
    ) -> tuple[Hashable, ObjectModel]:
        """An object that was named or sent, and the key under which it is kept; what a camera saw stands at a height [m].

        Raises:
            ObjectError: It cannot be used, or the server knows none of this name.
            OptionError: It cannot be used together with a camera.
        """
        if sent.name is not None and camera is not None:
            raise OptionError("a camera is given, and the object is named; send the cloud that the camera saw")
        if sent.name is not None and sent.name not in (known := self.object_names()):
            raise ObjectError(f"this server knows no object '{sent.name}', but {', '.join(known[:12])} and others (page "
                              "/objects); send the mesh or cloud, or start it with `dro-grasp serve --object FILE`")
        key = content_key(sent, camera), None if camera is None else height
        return key, self.library.loaded("object", key, lambda: self._load(sent, camera, height))

    def scene(self, sent: SentObject | None, camera: SentCamera | None) -> Scene | None:
        """Obstacles, in the frame of the grasps: what was sent, or an object of the server's own."""
        if sent is None:
            return None
        if sent.name is not None and sent.name not in self.library.own["object"]:
            raise ObjectError(f"obstacles names '{sent.name}', which the server was not started with; send the mesh or cloud")

        def load() -> Scene:
            with unpacked(sent, self.library.own["object"]) as source:
                scene = load_scene(source, scale=sent.scale)
                return scene if camera is None else scene.moved(sent_pose(camera).numpy())

        return self.library.loaded("scene", content_key(sent, camera), load)

    def chosen(self, call: Any) -> FoundObject:
        """The one thing of a scene that was sent.

        Raises:
            ObjectError: It is not there, or it is not clear which is meant.
            OptionError: The scene is named, or its table is to be kept.
        """
        sent, camera, choice = call.object, call.camera, call.choose
        if sent.name is not None:
            raise OptionError(f"choose is given, and the object is named '{sent.name}'; send the scene")
        if sent.keep_table:
            raise OptionError("choose is given, and keep_table keeps a table that is in an object's own cloud; leave "
                              "keep_table out: the table of a scene is found in any case, and hands stay above it")

        def load() -> Scene:
            seen_by = None if camera is None else SceneCamera(
                sent_pose(camera).numpy(), None if camera.intrinsics is None else np.array(camera.intrinsics), camera.frame,
                camera.depth_unit)
            with unpacked(sent, {}) as source:
                return load_scene(source, scale=sent.scale, camera=seen_by)

        scene = self.library.loaded("scene", (content_key(sent, camera), "seen"), load)
        with tempfile.TemporaryDirectory(prefix="dro-grasp-") as folder:
            mask = None
            if choice.mask is not None:
                mask = Path(folder) / "mask.png"
                mask.write_bytes(choice.mask.content)
            try:
                return scene.object_at(choice.at, pixel=choice.pixel, mask=mask, nearest=choice.nearest, part=choice.part)
            except DroGraspError as error:
                raise type(error)(str(error).replace(f"{folder}/", "")) from error

    def _load(self, sent: SentObject, camera: SentCamera | None, height: float | None) -> ObjectModel:
        with unpacked(sent, self.library.own["object"]) as source:
            if camera is None:
                return replace(load_object(source, scale=sent.scale, keep_table=sent.keep_table), file=None)
            check_scale(sent.scale)
            T = sent_pose(camera).numpy()
            if isinstance(source, Path):
                return load_scan(source, T, sent.scale, sent.keep_table, height)
            return scanned_object(
                "cloud", source * sent.scale, T, keep_table=sent.keep_table, table=level_plane(height, T))


def content_key(sent: SentObject, camera: SentCamera | None) -> bytes:
    """What tells objects apart: all that was sent of them."""
    key = hashlib.sha256(sent.model_dump_json(exclude={"file": {"content"}}).encode())
    key.update(b"" if sent.file is None else sent.file.content)
    key.update(b"" if camera is None else camera.model_dump_json().encode())
    return key.digest()


@contextmanager
def unpacked(sent: SentObject, own: Mapping[str, str]) -> Iterator[Any]:
    """What an object or scene is loaded from: a name or own file, points, or a sent file, alone in a folder of its own."""
    if sent.name is not None:
        yield own.get(sent.name, sent.name)
    elif sent.file is None:
        yield np.array(sent.points, np.float64).reshape(-1, 3)
    else:
        with tempfile.TemporaryDirectory(prefix="dro-grasp-") as folder:
            try:
                yield store_upload(sent.file.name, sent.file.content, Path(folder))
            except DroGraspError as error:
                raise type(error)(str(error).replace(f"{folder}/", "")) from error


def sent_pose(camera: SentCamera) -> Float[Tensor, "4 4"]:
    """The camera's pose in the named frame [m].

    Raises:
        OptionError: It is no rigid motion, or the frame has no proper name.
    """
    if not is_name(camera.frame):
        raise OptionError(f"frame is {camera.frame!r}; expected a name on one line, without control characters")
    T = torch.tensor(camera.T_frame_camera, dtype=torch.float64)
    if (fault := motion_fault(T)) is not None:
        raise OptionError(f"T_frame_camera must be 4 rows of 4 numbers, in metres; {fault}")
    return T


def sent_grasps(hand: Hand, grasps: GraspBatch, made: Prediction) -> list[SentGrasp]:
    """The grasps of a batch one by one."""
    rows = zip(grasps.wrist_position.tolist(), grasps.wrist_quaternion_wxyz.tolist(), grasps.joints.tolist(),
               grasps.pregrasp_joints.tolist(), grasps.squeeze_joints.tolist(), grasps.score.tolist(), made.origin, strict=True)
    reasons, efforts = grasps.extra.get(REASON) or [None] * len(grasps), squeeze_efforts(grasps, hand)
    torques = [None if effort is None else effort.tolist() for effort in (efforts_of(efforts, i) for i in range(len(grasps)))]
    return [
        SentGrasp(
            wrist_position=tuple(position), wrist_quaternion_wxyz=tuple(quaternion), joints=joints, pregrasp_joints=pregrasp,
            squeeze_joints=squeeze, squeeze_torque=torques[i], squeeze_force=known(grasps.squeeze_force[i]),
            payload=known(grasps.payload[i]), score=score, origin=origin,
            success=bool(grasps.success[i]) if grasps.evaluated[i] else None, reason=reasons[i] or None)
        for i, (position, quaternion, joints, pregrasp, squeeze, score, origin) in enumerate(rows)
    ]
