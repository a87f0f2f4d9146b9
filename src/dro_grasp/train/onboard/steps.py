"""Onboarding of a new hand: check, benchmark, synthesise, fine-tune, benchmark again; a rerun resumes where it stopped."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dro_grasp.compare.methods import Method
from dro_grasp.compare.metrics import difference_interval
from dro_grasp.compare.rows import Row
from dro_grasp.compare.stages import BEST, RAW, REFINED, RETURNED, BenchmarkConfig, benchmark
from dro_grasp.devices import require_device
from dro_grasp.errors import BundleError, OptionError
from dro_grasp.files import check_folder, make_folder, replacing, set_aside
from dro_grasp.hands.check import check_hand, picture
from dro_grasp.hands.library import load_hand
from dro_grasp.kinds import Checked, flat
from dro_grasp.network.checkpoints import DEFAULT, history_of, load_weights, locate_weights, save_weights
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.predict.config import AUTO, PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.sources.registry import FORMER_NAMES, source_or_name
from dro_grasp.simulation.protocols import PROTOCOLS, protocol
from dro_grasp.train.config import ScheduleConfig, TrainConfig
from dro_grasp.train.data.bundle.training_file import load_bundle, split_of
from dro_grasp.train.data.collections.bundling import make_bundle
from dro_grasp.train.data.collections.collection import count_collection
from dro_grasp.train.data.engine.schedule import FREE, require_distinct, require_known, synthesize_dataset
from dro_grasp.train.data.engine.shards import sole_run
from dro_grasp.train.data.engine.worker import EngineConfig
from dro_grasp.train.loop import train
from dro_grasp.train.run_folder import BOOKKEEPING

STATE = "onboarding.json"  # File of finished steps in the hand's folder
WEIGHTS = "weights.safetensors"  # File of the fine-tuned weights
REPORT = "report.html"  # File of the report
DATA = "data"  # Folder of synthesised grasps
PICTURE = "hand.png"  # File of the hand's picture
STRICT = PROTOCOLS["strict"].label  # Protocol by which fine-tuning is judged


@dataclass(frozen=True)
class OnboardingConfig(Checked):
    """How long onboarding takes, and on which objects."""

    minutes: float = 30.0  # time for data, training and trials together [min]
    objects: tuple[str, ...] = ("builtin:train",)  # objects to synthesise grasps of
    held_out: tuple[str, ...] = ("builtin:test",)  # objects of the benchmarks before and after; never trained on
    num: int = 20
    """Grasps that the network makes of each held-out object in each benchmark; `generate` returns a quarter as many."""
    weights: str | None = None  # weights to fine-tune; the shipped ones by default
    workers: int = 2  # processes of the synthesis
    source: str = AUTO  # where the grasps that `generate` returns come from, in benchmarks and report
    seed: int = 0  # of synthesis, benchmark and training
    device: str = "cpu"  # device of the network, its training and the energies; trials run on the CPU
    data_share: float = 0.45
    """Share of the time for synthesis (ours); what the shares leave is for the benchmarks before and after."""
    training_share: float = 0.40  # share of the time for fine-tuning (ours)
    most_grasps: int = 400  # grasps of an object beyond which time is better spent on training (ours)
    grasps_drawn: int = 8  # grasps in the report on each object
    objects_drawn: int = 3  # held-out objects in the report
    engine: EngineConfig = field(default_factory=EngineConfig)
    """The synthesis; its time and device follow from those above."""
    predictor: PredictorConfig = field(default_factory=PredictorConfig)  # what `generate` does, in benchmarks and report
    training: TrainConfig = field(default_factory=lambda: TrainConfig(
        ScheduleConfig(steps=10**6, learning_rate=3e-4), hands_per_step=1, samples_per_hand=16))
    """The fine-tuning; its time, seed and device follow from those above. The rate of training from scratch would overwrite the
    initial weights (ours)."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range, and a source that does not exist."""
        super().__post_init__()
        if not (math.isfinite(self.minutes) and self.minutes > 0):
            raise OptionError(f"minutes is {self.minutes}; give a positive number, for example --minutes 30")
        require_device(self.device)
        for name, value in (("num", self.num), ("workers", self.workers)):
            if value < 1:
                raise OptionError(f"{name} is {value}; give at least 1 (--{name})")
        source_or_name(self.source)


@dataclass(frozen=True)
class Onboarded:
    """Result of an onboarding."""

    hand: str
    folder: Path
    steps: dict[str, dict[str, Any]]  # result of each step by name, with its seconds: check, before, data, training, after
    config: OnboardingConfig

    @property
    def gained(self) -> bool:
        """Whether more of the network's refined grasps hold after fine-tuning than before, by more than chance.

        The 95 % interval of the difference has to be above 0: of weights that are no better, one in forty passes for better.
        """
        return difference_interval(*self.count("before", REFINED, STRICT), *self.count("after", REFINED, STRICT))[0] > 0

    @property
    def weights(self) -> str | None:
        """Weights to use from now on: the fine-tuned ones if they gained anything, else those from before."""
        return str(self.folder / WEIGHTS) if self.gained else self.config.weights

    @property
    def without_grasps(self) -> list[str]:
        """Objects of which synthesis found no grasp."""
        data = self.steps["data"]
        return [name for name in data["failures"] if not data["counts"].get(name)]

    def verdict(self) -> list[str]:
        """In words: whether fine-tuning gained anything, which objects are without grasps, and what to try."""
        (held, asked), (held_after, asked_after) = (self.count(step, REFINED, STRICT) for step in ("before", "after"))
        lines = []
        if not self.gained:
            low, high = difference_interval(held, asked, held_after, asked_after)
            better = "No more than all can hold" if held == asked else "To gain, try more --minutes or more --objects"
            if held_after > held:
                better += "; to tell a small gain from chance, more --num"
            lines.append(f"Fine-tuning gained nothing beyond chance: {held} of {asked} of the refined grasps hold under "
                         f"{STRICT} before, {held_after} of {asked_after} after ({100 * low:+.0f} to {100 * high:+.0f} points, "
                         f"95 %). Keep the weights from before. {better}.")
        if self.without_grasps:
            lines.append(f"No training grasps of {', '.join(self.without_grasps)}: try --objects of a size that suits the "
                         "hand, and look at its picture for a wrong palm side or opening.")
        return lines

    def rate(self, step: str, stage: str, label: str) -> float:
        """Success rate on the held-out objects, `before` or `after`."""
        return self._row(step, stage)["success"][label][0]

    def count(self, step: str, stage: str, label: str) -> tuple[int, int]:
        """How many grasps hold there, of how many that were asked for."""
        row = self._row(step, stage)
        return row["held"][label], row["asked"]

    def optimised(self, step: str) -> float:
        """Share of the optimiser in what `generate` returns, `before` or `after`."""
        return self._row(step, RETURNED)["optimised"]

    def _row(self, step: str, stage: str) -> dict[str, Any]:
        (row,) = (r for r in self.steps[step]["rows"] if r["stage"] == stage)
        return row


def onboard(
    hand: str, folder: Path | str, config: OnboardingConfig | None = None, say: Callable[[str], None] = print
) -> Onboarded:
    """Bring a hand from its description to weights of its own.

    Args:
        hand: Name or path of the description.
        folder: Folder of all results; made when missing.
        say: Called with a line about each step.

    Raises:
        HandError: The description cannot be used.
        ObjectError: An object does not exist.
        WeightsError: No weights have the name.
        OutputError: The folder cannot be made or written, or another run is filling it.
        OptionError: Training and held-out objects overlap, two to train on have one name, or the folder is another hand's or
            was begun otherwise.
        BundleError: No grasp of the hand holds, so there is nothing to train on.
    """
    config = config or OnboardingConfig()
    path = check_folder(folder)
    objects, held_out = resolve_objects(list(config.objects)), resolve_objects(list(config.held_out))
    if both := sorted(set(objects) & set(held_out)):
        raise OptionError(f"{', '.join(both)} would be trained on and evaluated as unseen; name other --objects or --held-out")
    require_known([hand], [*objects, *held_out])
    require_distinct([hand], objects)
    locate_weights(config.weights)
    onboarding = _Onboarding(hand, path, config, objects, held_out, say)
    with sole_run(make_folder(path)):
        onboarding.run()
    return Onboarded(hand, path, onboarding.steps, config)


class _Onboarding:
    """The steps of one hand, with the state that a rerun resumes from."""

    def __init__(
        self, hand: str, folder: Path, config: OnboardingConfig, objects: list[str], held_out: list[str],
        say: Callable[[str], None],
    ) -> None:
        self.name, self.folder, self.config, self.say = hand, folder, config, say
        self.objects, self.held_out = objects, held_out
        self.hand = load_hand(hand)
        self.steps: dict[str, dict[str, Any]] = {}
        state = folder / STATE
        known = self._known(state) if state.exists() else None
        if known is not None:
            if known["sha256"] != self.hand.sha256:
                raise OptionError(f"{folder} belongs to hand '{known['hand']}', whose description differs; name another "
                                  "folder, or restore that description")
            for name, asked in self._asked().items():
                if known["asked"].get(name, asked) != asked:
                    raise OptionError(f"{folder} was begun with {name} {known['asked'][name]}, {asked} was asked for; use the "
                                      "same to resume, or name another folder")
            self.steps = known["steps"]

    def _known(self, state: Path) -> dict[str, Any] | None:
        """What a run before has stored; a damaged file is set aside, and its steps are made again."""
        try:
            known = json.loads(state.read_text())
            return {"hand": str(known["hand"]), "sha256": str(known["sha256"]), "steps": dict(known["steps"]),
                    "asked": dict(known["asked"])}
        except (ValueError, LookupError, TypeError) as error:
            aside = set_aside(state)
            self.say(f"{state} is damaged ({type(error).__name__}) and set aside as {aside.name}; its steps are made again")
            return None

    def _asked(self) -> dict[str, Any]:
        """What decides on the results, beside the hand and the time."""
        config = self.config
        settings = flat(config.engine, "engine.") | flat(config.predictor, "predictor.") | flat(config.training, "training.")
        lasting = {name: value for name, value in settings.items()
                   if name.split(".", 1)[1].removeprefix("schedule.") not in FREE | BOOKKEEPING}
        asked = {"weights": config.weights or DEFAULT, "objects": self.objects, "held_out": self.held_out, "num": config.num,
                 "most_grasps": config.most_grasps, "source": FORMER_NAMES.get(config.source, config.source),
                 "seed": config.seed, **lasting}
        return json.loads(json.dumps(asked, default=str))

    def run(self) -> None:
        """Run every step that is not finished."""
        self.step("check", self._check)
        self.step("before", lambda: self._benchmark(self.config.weights))
        self.step("data", self._data)
        self.step("training", self._training)
        self.step("after", lambda: self._benchmark(str(self.folder / WEIGHTS)))

    def step(self, name: str, work: Callable[[], dict[str, Any]]) -> None:
        """Run a step unless it is finished, and store its result."""
        if name in self.steps:
            self.say(f"{name}: finished before")
            return
        begin = time.perf_counter()
        result = work()
        self.steps[name] = {**result, "seconds": time.perf_counter() - begin}
        content = {"hand": self.hand.name, "sha256": self.hand.sha256, "asked": self._asked(), "steps": self.steps}
        with replacing(self.folder / STATE) as temporary:
            temporary.write_text(json.dumps(content))
        self.say(f"{name}: {result['said']} ({self.steps[name]['seconds']:.0f} s)")

    def _check(self) -> dict[str, Any]:
        report = check_hand(self.name)
        picture(report.hand, self.folder / PICTURE)
        warnings = sum(note.level == "warning" for note in report.notes)
        return {"facts": report.to_dict(), "lines": report.lines(), "said": f"{self.hand.tree.n_dof} joints, "
                f"{len(self.hand.tips)} fingertips, {warnings} warnings"}

    def _benchmark(self, weights: str | None) -> dict[str, Any]:
        """Success rates on held-out objects: of the network, and of the grasps that `generate` returns."""
        predictor = GraspPredictor(weights, self.config.device, self.config.predictor)
        rules = tuple(protocol(name) for name in ("dro", "strict"))
        config = BenchmarkConfig(self.config.num, (RAW, REFINED, BEST, RETURNED), rules, seed=self.config.seed,
                                 device=self.config.device)
        objects = [load_object(name) for name in self.held_out]
        rows = benchmark([self.hand], objects, [Method(self.config.source, predictor)], config)
        told = "; ".join(map(_in_words, rows))
        share = f"{rows[-1].optimised:.0%} from the optimiser"
        return {"rows": [row.to_dict() for row in rows], "said": f"{predictor.weights_name}, {told}, {share}"}

    def _data(self) -> dict[str, Any]:
        config = self.config
        engine = replace(config.engine, seconds=60 * config.minutes * config.data_share,
                         synthesis=replace(config.engine.synthesis, device=config.device))
        report = synthesize_dataset([self.name], self.objects, config.most_grasps, self.folder / DATA, config.workers,
                                    config.seed, engine, self.say)
        counts = next(iter(count_collection(self.folder / DATA).values()), {})
        failures = {obj: why for (_, obj), why in report.failures.items()}
        if not sum(counts.values()):
            why = "; ".join(dict.fromkeys(failures.values())) or "too little time (--minutes)"
            raise BundleError(f"no grasp of {self.name} held, so there is nothing to train on; look at "
                              f"{self.folder / PICTURE}, and at why: {why}")
        return {"counts": counts, "failures": failures, "said": f"{sum(counts.values())} grasps that hold under strict, of "
                f"{sum(n > 0 for n in counts.values())} of {len(self.objects)} objects"}

    def _training(self) -> dict[str, Any]:
        path = self.folder / "bundle.safetensors"
        make_bundle([self.folder / DATA], path, split_of(self.hand.name, "train"))
        bundle, initial = load_bundle(path), load_weights(self.config.weights)
        schedule = replace(
            self.config.training.schedule, minutes=self.config.minutes * self.config.training_share, seed=self.config.seed,
            device=self.config.device)
        config = replace(self.config.training, schedule=schedule)
        run = self.folder / "run" / bundle.fingerprint  # data that are made again make another run
        model = train(bundle, initial.config, config, run, name=self.folder.name, initial=initial,
                      report=lambda run, means: self.say(f"step {run.step}: distance {1e3 * means['distance']:.1f} mm"))
        about = {"stage": "fine-tuning", "initial": initial.name, "data": bundle.summary(), "minutes": self.config.minutes}
        save_weights(model, self.folder / WEIGHTS, about, history_of(locate_weights(self.config.weights)))
        said = f"{initial.name} fine-tuned on {bundle.n_grasps} grasps"
        return {"grasps": bundle.n_grasps, "initial": initial.name, "said": said}


def _in_words(row: Row) -> str:
    """Stage and rates of a row, and how many grasps of those asked for were returned, if not all."""
    short = "" if row.returned == row.asked else f" ({row.returned} of {row.asked} returned)"
    return f"{row.stage}: " + ", ".join(f"{label} {rate[0]:.0%}" for label, rate in row.success.items()) + short
