"""The steps from nothing to data, labels and weights, in two sizes: as it is meant, and a rehearsal of minutes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dro_grasp.network.checkpoints import DEFAULT, SMALL
from lab.measurements import LABELS, TRIED
from lab.recipe.ranking import HANDS

PACKAGED = "src/dro_grasp/network/weights"
"""Where weights ship."""


@dataclass(frozen=True)
class Step:
    """One command; a rerun of a killed one goes on."""

    name: str
    command: str
    """`{run}` stands for a folder that belongs to this command and the content that it reads."""
    makes: str = ""
    """Its file, by which it is known to be done; a step without one is run each time, and finds what is missing itself."""
    reads: tuple[str, ...] = ()
    """Files and folders: with other content in them, it is run anew."""
    free: str = ""
    """Options that decide how fast it goes and not what comes out, with {workers}, {device} and {minutes}."""
    share: float = 0.0
    """Share of the time limit."""
    processes: bool = False
    """Whether torchrun divides it among processes, on a processor."""


@dataclass(frozen=True)
class Size:
    """How much of everything."""

    hands: tuple[str, ...]  # for training
    made: int  # made-up hands, from seed FIRST_MADE on
    known: tuple[str, ...]  # objects that all training hands grasp anew
    older: tuple[str, ...]  # training objects of the older grasps
    validate: tuple[str, ...]  # objects for measuring, which enter no training bundle
    procedural: str  # objects that seeds draw
    parts: tuple[str, str]
    """Of the pairs of training hands and procedural objects, and of those of made-up hands and all objects; prime numbers, so
    that each hand gets other objects."""
    grasps: int  # of a pair
    holds: str  # options by which a grasp is one that does
    shipped: str  # older grasps, which become labels by the filter
    most_shipped: int  # of a pair of these
    per_pair: int  # grasps in the training bundle
    pretraining: str
    training: str
    placement: str
    ranking: str
    holding: str
    completion: str
    into: str  # folder of the finished weights
    data: str = "{folder}/data"  # folder of new grasps
    labels: str = "{folder}/labels"  # folder of older grasps that hold
    learned: str = "{folder}/grasps"  # folder of the grasps that weights are made of

    @property
    def ships(self) -> bool:
        """Whether the finished weights replace those of the package."""
        return self.into == PACKAGED


FIRST_MADE = 100
"""Seed of the first made-up hand. Settings were chosen on hands of seeds below, and others are measured from 9000 on."""
FULL = Size(
    hands=HANDS, made=120, known=("builtin:train", "builtin:hard_train"), older=("assets:train",),
    validate=("assets:validate",), procedural="procedural:0-199 procedural:300-499", parts=("1/7", "1/79"), grasps=6,
    holds="--also robust --resettle", shipped="data/grasps", most_shipped=TRIED, per_pair=40,
    pretraining="--steps 6000 --motion-steps 10000",
    training="--steps 13000 --shards 2 --samples-per-hand 8 --by-count 0.5 --partial 0.25 --divergence 0.0005 "
    "--learning-rate 7e-4",
    placement="--steps 2600 --partial 0.25",
    ranking="--groups assets:train builtin:train builtin:hard_train procedural:0-199 --objects 16 --num 16 "
    "--trials carry robust",
    holding="--groups assets:train builtin:hard_train procedural:300-499 --made 64 --rounds 8 --num 32",
    completion="--objects assets:train builtin:train procedural:0-199 --steps 12000", into=PACKAGED, data="data/synthesized",
    labels=LABELS)
TINY = Size(
    hands=("gripper3",), made=2, known=("can", "torus"), older=(), validate=(), procedural="procedural:0-0",
    parts=("1/1", "1/2"), grasps=2, holds="", shipped="{folder}/data/known", most_shipped=6, per_pair=6,
    pretraining="--preset slim --steps 4 --motion-steps 4",
    training="--preset slim --steps 8 --shards 2 --samples-per-hand 2 --validation-samples 10", placement="--steps 4",
    ranking="--groups can torus sphere --objects 2 --num 8 --trials carry --views half depth --steps 100",
    holding="--groups can torus --made 1 --rounds 1 --num 8", completion="--objects can torus sphere --shapes 1 --steps 60",
    into="{folder}/weights/shipped")
RANKED = 40
"""Made-up hands of which the ranking network learns."""
AT_ONCE = "--workers {workers} --device {device} --minutes {minutes}"


def made_hands(size: Size, folder: str) -> list[str]:
    """Files of the made-up hands."""
    return [f"{folder}/made_hands/hand_{seed:05d}.urdf" for seed in range(FIRST_MADE, FIRST_MADE + size.made)]


def make_hands(size: Size, folder: str) -> Step:
    """The step that makes the made-up hands."""
    made = f"{folder}/made_hands"
    return Step("made hands", f"dro-grasp hand make --seed {FIRST_MADE} --num {size.made} --output {made} --overwrite",
                f"{made}/hands.csv")


def data(size: Size, folder: str) -> list[Step]:
    """Grasps that hold."""
    hands, known, procedural = " ".join(size.hands), " ".join(size.known), size.procedural
    everything = " ".join((*size.older, known, procedural))
    of_training, of_made = size.parts

    def grasps(name: str, of: str, on: str, share: float, options: str, each: int = size.grasps) -> Step:
        return Step(name, f"dro-grasp synthesize --hand {of} --object {on} --grasps {each} --output {size.data}/{name} "
                    f"{size.holds} {options}", free=AT_ONCE, share=share)

    return [
        make_hands(size, folder),
        grasps("known", hands, known, 0.3, "--seed 0"),
        grasps("fuller", hands, known, 0.15, "--idle 0.2 --seed 7", each=size.grasps // 2),
        grasps("procedural", hands, procedural, 0.25, f"--seed 0 --shard {of_training}"),
        grasps("made", " ".join(made_hands(size, folder)), everything, 0.3, f"--seed 0 --shard {of_made}"),
    ]


def labels(size: Size, folder: str) -> list[Step]:
    """Older grasps by the same measure, and all of them in one file a hand, in `FOLDER/grasps`."""
    made = " ".join(f"{size.data}/{step.name}" for step in data(size, folder) if step.share)
    return [
        Step("shipped", f"dro-grasp dataset merge {size.shipped} --output {folder}/shipped --per-pair {size.most_shipped}"),
        Step("labels", f"dro-grasp dataset filter {folder}/shipped --protocol carry --also robust --resettle --again "
             f"--output {size.labels}", free="--workers {workers}"),
        Step("grasps", f"dro-grasp dataset merge {made} {size.labels} --output {folder}/grasps --per-pair 150"),
        Step("card", f"python -m lab.benchmarks.data_card {folder}/grasps"),
    ]


def weights(size: Size, folder: str) -> list[Step]:
    """The set of four weights, in `FOLDER/weights`, and where they ship; then what the scores are worth of guessed surfaces."""
    grasps, own = size.learned.replace("{folder}", folder), f"{folder}/weights"
    bundle, validation, pretrained, trained, network, surface, quality, holding = (
        f"{own}/{name}.safetensors" for name in (
            "bundle", "validation", "pretrained", "trained", DEFAULT, *SMALL))
    made = " ".join(made_hands(size, folder)[:RANKED])
    checked = validation if size.validate else bundle
    run, seed = "--run-folder {run}", "--seed 0"

    def trains(name: str, command: str, output: str, *reads: str, processes: bool = True) -> Step:
        return Step(name, f"dro-grasp {command} --bundle {bundle} {run} --output {output} {seed}", output, (bundle, *reads),
                    "--device {device}", processes=processes)

    def packs(name: str, output: str, options: str) -> Step:
        return Step(name, f"dro-grasp dataset bundle {grasps} --output {output} {options}", output, (grasps,))

    guesses = Step("guesses", "python -m lab.studies.seen_score --folder {run}", reads=(network, quality, holding, surface))
    steps = [make_hands(size, folder), packs("bundle", bundle, f"--per-pair {size.per_pair}")]
    if size.validate:
        steps.append(packs("validation", validation, "--split validate --per-pair 20"))
    return [
        *steps,
        trains("pretraining", f"pretrain {size.pretraining}", pretrained, processes=False),
        trains("training", f"train {size.training} --pretrained {pretrained} --validation {checked}", trained, pretrained,
               checked),
        trains("placement", f"train --part placement {size.placement} --initial {trained} --validation {checked}"
               f"{'' if size.validate else ' --validation-samples 10'}", network, trained, checked, processes=False),
        Step("completion", f"python -m lab.recipe.completion --folder {{run}} --output {surface} {size.completion} {seed}",
             surface, free="--workers {workers}"),
        Step("ranking", f"python -m lab.recipe.ranking --folder {{run}} --weights {network} --surface {surface} "
             f"--output {quality} --hands {' '.join(size.hands)} {made} {size.ranking} {seed}", quality, (network, surface),
             "--workers {workers}"),
        Step("holding", f"python -m lab.recipe.holding --folder {{run}} --weights {network} --ranking {quality} "
             f"--output {holding} --hands {' '.join(size.hands)} {size.holding}", holding, (network, quality),
             "--workers {workers}"),
        Step("set", f"python -m lab.recipe.pack {own} --into {size.into}{'' if size.ships else ' --changed'}"),
        *([guesses] if size.ships else []),
    ]


STAGES: dict[str, Callable[[Size, str], list[Step]]] = {"data": data, "labels": labels, "weights": weights}
"""What can be made, in this order."""
