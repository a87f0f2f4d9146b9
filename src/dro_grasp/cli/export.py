"""`dro-grasp export`: grasps for other software and for robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dro_grasp.cli.evaluate import compare
from dro_grasp.cli.inputs import Flag, optional
from dro_grasp.cli.output import folder_for, print_json, say
from dro_grasp.errors import GraspFileError, OutputError
from dro_grasp.files import check_output, free_name, make_folder, replacing
from dro_grasp.grasps.export.formats import FORMATS, ExportJob

if TYPE_CHECKING:
    from dro_grasp.grasps.batch import GraspBatch
    from dro_grasp.grasps.export.writers import Frame


@dataclass(frozen=True)
class Export:
    """Export grasps in the format of other software.

    Example: dro-grasp export grasps.parquet --format isaac_grasp --output grasps.yaml
    """

    file: tyro.conf.Positional[Path]  # Grasp file, or a folder of them, as `generate` fills it for a folder of objects.
    format: Annotated[str, tyro.conf.arg(
        constructor=tyro.extras.literal_type_from_choices(FORMATS),
        help=" ".join(f"{name}: {form.explanation}." for name, form in FORMATS.items()))]
    output: Path  # File to write. For dexgraspbench and for several objects: a folder, created if missing.
    frame: Annotated[Path | None, optional("JSON", "the object's frame")] = None
    """File with {"frame": "camera", "T_frame_object": 4x4}: the frame of the exported poses."""
    only_successful: Flag = False  # Export only grasps that passed their trial.
    hand: Annotated[str | None, optional("NAME|PATH", "the file's")] = None  # Hand to use instead of the one named in the file.
    object: Annotated[str | None, optional("NAME|PATH", "the file's")] = None
    """Object to use instead of the one named in the file, for a file with one object. Needed for pregrasps, usd and --hold."""
    hold: Flag = False  # State what joints and efforts to expect with the object in the hand and without, as simulated.
    json: Flag = False  # Print one JSON object.

    def run(self) -> int:
        """Complete the grasps, then write a file for each object."""
        from dro_grasp.grasps.export.writers import Frame
        from dro_grasp.grasps.sources import require_one_object

        frame = Frame() if self.frame is None else Frame.load(self.frame)
        grasps, form = self._load(), FORMATS[self.format]
        require_one_object(grasps, self.object, self.file)
        batches = dict(grasps.by_object())
        folder = form.file_per_grasp or len(batches) > 1
        target = folder_for(self.output, form.suffix, len(batches)) if folder else check_output(self.output, form.suffix)
        if folder:
            refuse_mixing(target, form.suffix)
        jobs = {name: self._job(batch, frame) for name, batch in batches.items()}
        if folder:
            make_folder(target)
        written, labels = list[Path](), set[str]()
        for name, job in jobs.items():
            label = free_name(name.replace("/", "-").lstrip(".") or "object", labels)
            labels.add(label)
            place = target / (label if form.file_per_grasp else f"{label}{form.suffix}")
            written += write(form.content(job), place if len(jobs) > 1 else target, form.suffix)
        if self.json:
            frames = {frame.stated(batch) for batch in batches.values()}
            print_json({"format": self.format, "frame": frames.pop() if len(frames) == 1 else sorted(frames),
                        "num": len(grasps), "files": [str(p) for p in written]})
        else:
            say(f"{len(grasps)} grasps in {len(written)} file{'s' if len(written) > 1 else ''}: {target}")
        return 0

    def _load(self) -> GraspBatch:
        """The requested grasps."""
        from dro_grasp.grasps.batch import load_grasps

        grasps = load_grasps(self.file)
        if not self.only_successful:
            return grasps
        if not bool(grasps.trial_success.any()):
            raise GraspFileError(f"no grasp in {self.file} has passed a trial; run trials with `dro-grasp evaluate`, or "
                                 "leave out --only-successful")
        return grasps[grasps.success]

    def _job(self, grasps: GraspBatch, frame: Frame) -> ExportJob:
        """One object's grasps, each with pregrasp and squeeze; hand and object are loaded where they are needed."""
        import torch

        from dro_grasp.grasps.controller import complete
        from dro_grasp.grasps.sources import hand_of, object_of, object_source

        stated = bool(grasps.states_closing.all())
        forces = bool(grasps.squeeze_torque.isfinite().any())  # which are clipped to what the hand exerts
        needed = FORMATS[self.format].needs_hand or not stated or forces or self.hold
        hand = hand_of(grasps, self.hand) if needed or self.hand is not None else None
        if hand is not None:
            grasps.require_hand(hand)
            compare("hand", grasps.hand, grasps.hand_sha256, hand)
        needed = FORMATS[self.format].needs_object or not stated or self.hold
        obj = object_of(grasps, self.object) if needed or self.object is not None else None
        if obj is not None:
            compare("object", grasps.object[0], next(filter(None, grasps.object_sha256), ""), obj)
        if hand is not None and obj is not None and not stated:
            grasps = complete(hand, grasps, torch.as_tensor(obj.centre_of_mass, dtype=grasps.joints.dtype))
        if hand is not None and obj is not None and self.hold:
            from dro_grasp.simulation.holding import expect_hold

            grasps = expect_hold(hand, obj, grasps)
        path, scale = object_source(grasps)
        if obj is not None and self.object is not None:
            path, scale = obj.file or self.object, obj.scale
        return ExportJob(grasps, frame, hand, path, scale, obj)


def write(content: bytes | list[bytes], path: Path, suffix: str) -> list[Path]:
    """Write one file at the path, or one per grasp in a folder of that name; returns their paths."""
    files = {path: content} if isinstance(content, bytes) else {
        make_folder(path) / f"{i}{suffix}": entry for i, entry in enumerate(content)}
    for place, entry in files.items():
        with replacing(place) as temporary:
            temporary.write_bytes(entry)
    return list(files)


def refuse_mixing(folder: Path, suffix: str) -> None:
    """Refuse a folder that holds files of a format, itself or one level down: a reader could not tell old grasps from new."""
    old = next((path for pattern in (f"*{suffix}", f"*/*{suffix}") for path in folder.glob(pattern)), None)
    if old is not None:
        raise OutputError(f"cannot write grasps into {folder}: it holds {suffix[1:]} files already "
                          f"({old.relative_to(folder)}), and old and new grasps would be mixed; choose an empty folder or a "
                          "new one")
