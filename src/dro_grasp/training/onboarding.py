"""Onboarding of a new hand: check, benchmark, synthesize, fine-tune, benchmark again, and a report as one web page.

A rerun resumes where it stopped.
"""

from __future__ import annotations

import html
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
from dro_grasp.errors import BundleError, NoGraspError, OptionError
from dro_grasp.files import check_folder, command, make_folder, replacing, set_aside
from dro_grasp.hands.check import check_hand, picture
from dro_grasp.hands.hand import Hand
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.kinds import Checked, flat, require_positive, require_seed
from dro_grasp.network.checkpoints import DEFAULT, history_of, load_weights, locate_weights, save_weights
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.pictures.sheets import draw_grasps
from dro_grasp.pictures.web_page import image, table, write_page
from dro_grasp.predict.config import AUTO, GraspRequest, PredictorConfig
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.sources.registry import source_or_name
from dro_grasp.predict.stages import evaluate
from dro_grasp.provenance import made_by
from dro_grasp.simulation.protocols import DEFAULT_PROTOCOL, PROTOCOLS, protocol
from dro_grasp.simulation.worlds import require_worlds
from dro_grasp.training.config import ScheduleConfig, TrainConfig
from dro_grasp.training.data.bundle.training_file import load_bundle, split_of
from dro_grasp.training.data.collections.bundling import make_bundle
from dro_grasp.training.data.collections.collection import count_collection
from dro_grasp.training.data.engine.schedule import FREE, require_distinct_names, require_known, synthesize_dataset
from dro_grasp.training.data.engine.shards import sole_run
from dro_grasp.training.data.engine.worker import EngineConfig
from dro_grasp.training.loop import train
from dro_grasp.training.runs import BOOKKEEPING

STATE = "onboarding.json"  # File of finished steps in the hand's folder
WEIGHTS = "weights.safetensors"  # File of the fine-tuned weights
REPORT = "report.html"  # File of the report
DATA = "data"  # Folder of synthesized grasps
PICTURE = "hand.png"  # File of the hand's picture
JUDGE = PROTOCOLS[DEFAULT_PROTOCOL].label  # Protocol by which fine-tuning is judged


@dataclass(frozen=True)
class OnboardingConfig(Checked):
    """How long onboarding takes, and on which objects."""

    minutes: float = 30.0  # time for data, training and trials together [min]; trials are not cut off when it is over
    objects: tuple[str, ...] = ("builtin:train",)  # objects to synthesize grasps of
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
            raise OptionError(f"minutes is {self.minutes}; give a positive number, for example minutes=30")
        require_device(self.device)
        require_worlds(self.device)
        require_seed(self.seed, 31)
        require_positive(num=self.num, workers=self.workers, most_grasps=self.most_grasps, grasps_drawn=self.grasps_drawn)
        if min(shares := (self.data_share, self.training_share)) <= 0 or sum(shares) > 1:
            raise OptionError(f"data_share and training_share are {shares}; give two positive numbers, at most 1 together")
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
        return difference_interval(*self.count("before", REFINED, JUDGE), *self.count("after", REFINED, JUDGE))[0] > 0

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
        (held, asked), (held_after, asked_after) = (self.count(step, REFINED, JUDGE) for step in ("before", "after"))
        lines = []
        if not self.gained:
            low, high = difference_interval(held, asked, held_after, asked_after)
            better = "No more than all can hold" if held == asked else "To gain, try more minutes or more objects"
            if held_after > held:
                better += "; to tell a small gain from chance, evaluate more grasps (num=...)"
            lines.append(f"Fine-tuning gained nothing beyond chance: {held} of {asked} of the refined grasps hold under "
                         f"{JUDGE} before, {held_after} of {asked_after} after ({100 * low:+.0f} to {100 * high:+.0f} points, "
                         f"95 %). Keep the weights from before. {better}.")
        if self.without_grasps:
            lines.append(f"No training grasps of {', '.join(self.without_grasps)}: try objects of a size that suits the "
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
    """Bring a hand, of this name or with this description, to weights of its own; all results are in the folder."""
    config = config or OnboardingConfig()
    path = check_folder(folder)
    objects, held_out = resolve_objects(list(config.objects)), resolve_objects(list(config.held_out))
    if both := sorted(set(objects) & set(held_out)):
        raise OptionError(f"{', '.join(both)} would be trained on and evaluated as unseen; name others (objects=..., "
                          "held_out=...)")
    require_known([hand], [*objects, *held_out])
    require_distinct_names([hand], objects)
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
            known = json.loads(state.read_text(encoding="utf-8"))
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
                 "most_grasps": config.most_grasps, "source": config.source,
                 "seed": config.seed, **lasting}
        return json.loads(json.dumps(asked, default=str))

    def run(self) -> None:
        """Run every step that is not finished."""
        self.step("check", self._check)
        if "after" not in self.steps:
            self.say(self.plan())
        self.step("before", lambda: self._benchmark(self.config.weights))
        self.step("data", self._data)
        self.step("training", self._training)
        self.step("after", lambda: self._benchmark(str(self.folder / WEIGHTS)))

    def plan(self) -> str:
        """What takes how long, in one line: the benchmarks are not cut off when the time is over."""
        config = self.config
        shares = (f"{config.minutes * share:.3g} min for {what}" for share, what in (
            (config.data_share, "data"), (config.training_share, "training")))
        return (f"{' and '.join(shares)}; two benchmarks, each of {config.num} grasps on {len(self.held_out)} objects, take as "
                "long as they take: fewer objects and grasps are quicker (held_out=..., num=...)")

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
            temporary.write_text(json.dumps(content), encoding="utf-8")
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
        rules = tuple(protocol(name) for name in ("dro", "strict", DEFAULT_PROTOCOL))
        config = BenchmarkConfig(self.config.num, (RAW, REFINED, BEST, RETURNED), rules, seed=self.config.seed,
                                 device=self.config.device)
        objects = [load_object(name) for name in self.held_out]
        rows = benchmark([self.hand], objects, [Method(self.config.source, predictor)], config, self._count)
        told = "; ".join(map(_in_words, rows))
        share = f"{rows[-1].optimised:.0%} from the optimiser"
        return {"rows": [row.to_dict() for row in rows], "said": f"{predictor.weights_name}, {told}, {share}"}

    def _count(self, done: int, total: int) -> None:
        self.say(f"benchmark: {done} of {total} objects")

    def _data(self) -> dict[str, Any]:
        config = self.config
        engine = replace(config.engine, seconds=60 * config.minutes * config.data_share,
                         synthesis=replace(config.engine.synthesis, device=config.device)).suited()
        report = synthesize_dataset([self.name], self.objects, config.most_grasps, self.folder / DATA, config.workers,
                                    config.seed, engine, self.say)
        counts = next(iter(count_collection(self.folder / DATA).values()), {})
        failures = {obj: why for (_, obj), why in report.failures.items()}
        if not sum(counts.values()):
            why = "; ".join(dict.fromkeys(failures.values())) or "too little time (minutes=...)"
            raise BundleError(f"no grasp of {self.name} held, so there is nothing to train on; look at "
                              f"{self.folder / PICTURE}, and at why: {why}")
        said = (f"{sum(counts.values())} grasps that hold under {config.engine.protocol}, of "
                f"{sum(n > 0 for n in counts.values())} of {len(self.objects)} objects")
        return {"counts": counts, "failures": failures, "said": said}

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
        data = bundle.summary() | {"fingerprint": bundle.fingerprint}
        about = {"stage": "fine-tuning", **made_by(), "initial": initial.name, "data": data, "minutes": self.config.minutes}
        save_weights(model, self.folder / WEIGHTS, about, history_of(locate_weights(self.config.weights)))
        said = f"{initial.name} fine-tuned on {bundle.n_grasps} grasps"
        return {"grasps": bundle.n_grasps, "initial": initial.name, "said": said}


def _in_words(row: Row) -> str:
    """Stage and rates of a row, and how many grasps of those asked for were returned, if not all."""
    short = "" if row.returned == row.asked else f" ({row.returned} of {row.asked} returned)"
    return f"{row.stage}: " + ", ".join(f"{label} {rate[0]:.0%}" for label, rate in row.success.items()) + short


STAGES = {RAW: "network alone", REFINED: "network, refined", BEST: "network, refined, best quarter", RETURNED: "generate"}
"""What the grasps of each stage are called."""


def write_report(done: Onboarded) -> Path:
    """Write the page into the folder of the hand, and return its path; grasps on some held-out objects are drawn."""
    path, name = done.folder / REPORT, html.escape(locate_hand(done.hand).name)
    parts = [
        f"<h1>{name}</h1>", _summary(done), _rates(done),
        "<h2>What generate returns with the better weights</h2>", _drawn(done),
        f"<h2>The description</h2><p class=note>{html.escape(done.hand)}</p>",
        image((done.folder / PICTURE).read_bytes(), f"{name}, open and closed"),
        f"<pre>{html.escape(chr(10).join(done.steps['check']['lines']))}</pre>", "<h2>Training grasps</h2>",
        _data(done.steps["data"]), "<h2>Next steps</h2>", _commands(done),
    ]
    write_page(path, f"{name} onboarded", "".join(parts))
    return path


def _summary(done: Onboarded) -> str:
    before, after = (done.rate(step, REFINED, JUDGE) for step in ("before", "after"))
    best = done.rate("after", BEST, JUDGE)
    returned = " and ".join(
        f"{done.rate(step, RETURNED, JUDGE):.0%} {step} ({done.optimised(step):.0%} of them made by the optimiser)"
        for step in ("before", "after"))
    minutes = sum(step["seconds"] for step in done.steps.values()) / 60
    return (f"<p>On held-out objects, {before:.0%} of the refined grasps pass protocol <i>carry</i> before fine-tuning, and "
            f"{after:.0%} after fine-tuning on {done.steps['training']['grasps']:,} grasps of this hand; of the best quarter "
            f"by score, {best:.0%} pass. Of the grasps that <i>generate</i> returns, {returned} pass. All steps took "
            f"{minutes:.0f} minutes.</p>" + "".join(f"<p><b>{html.escape(line)}</b></p>" for line in done.verdict()))


def _rates(done: Onboarded) -> str:
    rows = []
    for step in ("before", "after"):
        for row in done.steps[step]["rows"]:
            rates = [f"{100 * p:.0f} % [{100 * low:.0f}-{100 * high:.0f}]" for p, low, high in row["success"].values()]
            touching, all_touch = (100 * share for share in row["fingers"][JUDGE])
            rows.append([step, STAGES[row["stage"]], row["asked"], row["returned"], *rates, f"{touching:.0f} ({all_touch:.0f})",
                         f"{100 * row['optimised']:.0f} %", f"{row['diversity']:.2f}"])
    labels = list(done.steps["after"]["rows"][0]["success"])
    return table(["weights", "grasps", "asked", "returned", *labels, "fingers [%]", "by the optimiser", "diversity"], rows) + (
        "<p class=note>Success rates of the grasps asked for, with 95 % intervals. dro is the paper's protocol and lenient; "
        "strict also limits penetration and how far closing may push the object; carry pulls with the object's weight, and "
        "fingers are as strong as they are. Fingers: the share of the hand's that touch the object, and in parentheses of "
        "the grasps with all of them. The network's rows are what fine-tuning improves. <i>generate</i> keeps the best of "
        "four of the network's candidates by score, as the row <i>best quarter</i> does, and asks the optimiser for others "
        "where the score does not trust these: slower, and less needed the better the network is. <i>generate --source "
        "network</i> does without.</p>")


def _drawn(done: Onboarded) -> str:
    config = done.config
    hand, predictor = load_hand(done.hand), GraspPredictor(done.weights, config.device, config.predictor)
    parts = []
    for number, name in enumerate(resolve_objects(list(config.held_out))[: config.objects_drawn], 1):
        try:
            parts.append(_drawn_on(name, done.folder / f"grasps_{number}.png", done, hand, predictor))
        except NoGraspError as error:
            parts.append(f"<p class=note>{html.escape(name)}: none was found: {html.escape(str(error))}</p>")
    return "".join(parts)


def _drawn_on(name: str, path: Path, done: Onboarded, hand: Hand, predictor: GraspPredictor) -> str:
    obj, asked = load_object(name), done.config.grasps_drawn
    problem = GraspProblem(hand, obj, predictor.device)
    made = predictor.run(problem, GraspRequest(asked, source=done.config.source))
    draw_grasps(hand, obj, evaluate(problem, made.grasps), path)
    by_optimiser, short = made.origin.count("optimiser"), ""
    if len(made.grasps) < asked:
        short = f"; {len(made.grasps)} of the {asked} asked for were found"
    return (image(path.read_bytes(), f"grasps of {name}")
            + f"<p class=note>{html.escape(name)}: {by_optimiser} of {len(made.grasps)} made by the optimiser{short}</p>")


def _data(step: dict[str, Any]) -> str:
    rows = [[name, count, step["failures"].get(name, "")] for name, count in sorted(step["counts"].items())]
    missing = [[name, 0, why] for name, why in step["failures"].items() if name not in step["counts"]]
    return table(["object", "grasps", "why no more"], [*rows, *missing])


def _commands(done: Onboarded) -> str:
    weights = () if done.weights is None else ("--weights", done.weights)
    source = () if done.config.source == AUTO else ("--source", done.config.source)
    lines = [
        command("dro-grasp", "generate", "--hand", done.hand, "--object", "my_mesh.stl", *weights, *source)
        + " --output grasps.parquet",
        "dro-grasp evaluate grasps.parquet --protocol robust",
        "dro-grasp export grasps.parquet --format isaac_grasp --output grasps.yaml --only-successful",
        command("dro-grasp", "dataset", "report", done.folder / DATA, "--output", "data.html"),
    ]
    return f"<pre>{html.escape(chr(10).join(lines))}</pre>"
