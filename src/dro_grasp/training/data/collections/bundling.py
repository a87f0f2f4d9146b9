"""From collections to a training bundle: choose the grasps that may enter, find their hands and objects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch

from dro_grasp.errors import BundleError, OptionError
from dro_grasp.grasps.batch import GraspBatch
from dro_grasp.hands.hand import Hand
from dro_grasp.kinds import checked
from dro_grasp.training.data.bundle.training_file import SPLITS, Bundle, ObjectCloud, write_bundle
from dro_grasp.training.data.collections.collection import Sources, read_collection
from dro_grasp.training.data.collections.merging import require_choice, spread

CLOUD_POINTS = 4096
"""Points of an object in a bundle (ours), of the 16,384 that it has in memory: a sample has 128 to 512 of them."""


@checked
def make_bundle(
    inputs: Sequence[Path], output: Path, split: str = "train", hands: Sequence[str] = (), per_pair: int | None = None,
    without_grasps: Sequence[Hand] = (),
) -> tuple[Bundle, int]:
    """Write the bundle of a split's grasps; returns it, and how many grasps of other splits were left out.

    Args:
        inputs: As in `read_collection`.
        split: One of SPLITS.
        hands: Only these; all when none is named.
        per_pair: As in `merge`.
        without_grasps: As in `write_bundle`.

    Raises:
        OptionError: `per_pair` is less than 1, there is no such split, or no grasp of one of `hands`.
        BundleError: It cannot be made of these grasps.
        GraspFileError: A file is damaged, or a hand or an object has changed since.
        OutputError: It cannot be written.
    """
    require_choice(per_pair)
    if split not in SPLITS:
        raise OptionError(f"split is '{split}'; choose {', '.join(SPLITS)}")
    allowed, kept, left_out = SPLITS[split], [], 0
    seen: Counter[str] = Counter()
    hands_seen: set[str] = set()
    for pair in (pair for path in inputs for pair in read_collection(path)):
        hands_seen |= {pair.hand, pair.grasps.hand}
        if hands and pair.hand not in hands and pair.grasps.hand not in hands:
            continue
        grasps = pair.grasps[[i for i, name in enumerate(pair.grasps.split) if name in allowed]]
        seen.update(pair.grasps.split)
        left_out += len(pair.grasps) - len(grasps)
        if len(grasps):
            kept.append(grasps)
    if unknown := [name for name in hands if name not in hands_seen]:
        raise OptionError(f"no grasps of {', '.join(unknown)} were given, but of {', '.join(sorted(hands_seen))}; name one of "
                          "these with hands=..., or leave it out")
    if not kept:
        raise BundleError(_why_none(split, seen))
    found, clouds, kept = sources(kept)
    if per_pair is not None:
        by_hash = {hand.sha256: hand for hand in found}
        kept = [grasps[spread(by_hash[grasps.hand_sha256], grasps, per_pair)] for grasps in kept]
    return write_bundle(output, found, clouds, kept, allowed, without_grasps), left_out


def _why_none(split: str, seen: Counter[str]) -> str:
    """Error text: the grasps that were given instead of the split's, and what to do."""
    if not seen:
        return "no grasps that held in a trial were given; `dro-grasp synthesize` makes some, `dro-grasp evaluate` tests others"
    counts = ", ".join(f"{number} of split '{name}'" for name, number in sorted(seen.items()))
    fitting = sorted(name for name, allowed in SPLITS.items() if allowed & set(seen))
    advice = f"choose split='{' or '.join(fitting)}'" if fitting else "grasps on objects for tests are never bundled"
    where = "hands and objects for training" if split == "train" else f"hands and objects of split '{split}'"
    return f"no grasps of split '{split}' were given, but {counts}; {advice}, or make grasps of {where} (`dro-grasp objects`)"


def sources(batches: list[GraspBatch]) -> tuple[list[Hand], dict[str, ObjectCloud], list[GraspBatch]]:
    """Hands and object clouds of batches of one hand and one object, each once, and the batches with the hashes of these."""
    loaded, stated = Sources(), []
    for grasps in batches:
        hand, obj = loaded.of(grasps)
        stated.append(grasps.replace(hand_sha256=hand.sha256, object_sha256=(obj.sha256,) * len(grasps)))
    found = {hand.sha256: hand for hand in reversed(loaded.hands.values())}
    named = {(name, obj.sha256): obj for (name, *_), obj in loaded.objects.items()}
    for kind, names in (("hand", [hand.name for hand in found.values()]), ("object", [name for name, _ in named])):
        double = sorted({name for name in names if names.count(name) > 1})
        if double:
            raise BundleError(f"different {kind}s are called {', '.join(double)}; rename them and synthesize again")
    clouds = {
        name: ObjectCloud(torch.from_numpy(obj.cloud[:CLOUD_POINTS]), torch.from_numpy(obj.cloud_normals[:CLOUD_POINTS]))
        for (name, _), obj in named.items()}
    return [found[sha256] for sha256 in dict.fromkeys(hand.sha256 for hand in loaded.hands.values())], clouds, stated
