"""`dro-grasp benchmark`: success rates of methods side by side."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dro_grasp.cli.inputs import Flag, Mass, ProtocolName, given_forces, optional
from dro_grasp.cli.output import print_json, progress_bar, say
from dro_grasp.errors import ObjectError, OptionError
from dro_grasp.kinds import require_positive

if TYPE_CHECKING:
    from dro_grasp.compare.methods import Method
    from dro_grasp.compare.rows import Row
    from dro_grasp.objects.shape import ObjectModel

QUICK: dict[str, Any] = {"num": 16, "stages": ("returned",), "protocols": ("carry", "strict")}
"""What --quick measures: of 16 candidates a pair, methods return a quarter (ours)."""
QUICK_OBJECTS = 2  # Objects that --quick takes (ours)


@dataclass(frozen=True)
class Benchmark:
    """Evaluate the grasps of several methods, before and after refinement and ranking, in one table.

    Example: dro-grasp benchmark --methods auto optimiser dfc my_module:MySource --hands allegro barrett --stages returned
    """

    methods: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--method"], metavar="NAME...", help_behavior_hint=(
        "(default: auto, start, optimiser, and with a bundle mean-grasp, mean-grasp-chosen)"))] = ()
    """What proposes the grasps: auto, network, optimiser, dfc, start, mean-grasp or mean-grasp-chosen; network@WEIGHTS or
    auto@WEIGHTS for other weights; module:Class for a source of yours; PATH for a grasp file."""
    hands: tuple[str, ...] = ("allegro", "barrett", "shadowhand")  # Names or paths of hands.
    objects: tuple[str, ...] = ("builtin:test",)
    """Objects with meshes: names, paths, folders, or groups such as assets:validate."""
    dexgraspbench: Annotated[Path | None, optional("FOLDER", "the objects above")] = None
    """Folder of a clone of DexGraspBench, or of its archive of objects. All its objects at the official scales replace
    --objects."""
    num: int = 100  # Grasps of each hand on each object, of which ranking keeps the best quarter.
    stages: tuple[Literal["raw", "ranked", "refined", "settled", "returned", "equal-time"], ...] = (
        "raw", "ranked", "refined")
    """What is done to the grasps before the trials. refined and settled report all grasps, and the best by score. settled:
    refined grasps after their closing was simulated. returned: what `generate --source` returns. equal-time: every method
    gets as much CPU time a grasp as the first."""
    protocols: tuple[ProtocolName, ...] = ("carry", "dexgraspbench", "strict")
    """Protocols of the trials. Displacement, rotation and diversity are means over the successes of the first."""
    weights: Annotated[str | None, optional("NAME|PATH", "the shipped weights")] = None  # Weights of the network.
    device: str = "cpu"  # Device for the network and the energies: cpu, cuda or cuda:1. Trials always run on the CPU.
    temperature: Annotated[float | None, optional("T", "1; 0.5 for bare clouds")] = None
    """Diversity of the grasps of one placement: 0 proposes the likeliest, 1 as diverse ones as in training, 2 the most."""
    least_confidence: Annotated[float | None, optional("P", "0.2")] = None
    """Grasps that hold with less probability are not returned, and count as failures; 0 returns all."""
    candidates: int = 4  # Most candidates for each grasp of stage returned, as in `generate`.
    controls: bool = True  # Without --methods: also evaluate start, optimiser and, with a bundle, the mean grasp.
    bundle: Annotated[Path | None, optional("PATH", "no mean grasp")] = None
    """Training bundle whose grasps are averaged to the mean grasp."""
    contact_quality: Flag = False
    """Also measure the analytic metrics of DexGraspBench, with its friction: penetration, contact distance, force closure."""
    quick: Flag = False
    """A first look: what the methods return, four grasps of each hand on the first two objects, under carry and strict."""
    view: Literal["whole", "cloud", "half", "depth"] = "whole"
    """What methods, refinement and ranking see: the mesh (whole), its points (cloud), half of them as in the paper (half), or
    a depth image (depth)."""
    mass: Mass = None  # Mass of every object [kg].
    margin: Annotated[float | None, optional("TIMES", "1.5")] = None  # Multiple of the weight that squeezes hold.
    max_force: Annotated[float | None, optional("N", "any")] = None  # Largest normal force of a contact at the squeeze [N].
    views: int = 1  # Views of each object for each hand, with --num grasps each.
    seed: int = 0  # The same seed gives the same grasps and views.
    json: Flag = False  # Print one JSON object instead of a Markdown table.

    def run(self) -> int:
        """Load everything, measure, print."""
        if self.quick:
            return dataclasses.replace(self, quick=False, **QUICK)._measure(QUICK_OBJECTS)
        return self._measure(None)

    def _measure(self, most: int | None) -> int:
        """All of it, with at most so many objects."""
        from dro_grasp.compare.stages import BEST, REFINED, SETTLED, SETTLED_BEST, TOP, BenchmarkConfig, benchmark
        from dro_grasp.hands.library import load_hand
        from dro_grasp.predict.config import GraspRequest
        from dro_grasp.predict.constraints import Constraints
        from dro_grasp.simulation.protocols import protocol

        GraspRequest(self.num, candidates=self.candidates, temperature=self.temperature, least_confidence=self.least_confidence)
        settles = {"settled", "returned", "equal-time"} & set(self.stages)
        if not settles and (idle := given_forces(self.margin, self.max_force)):
            raise OptionError(f"{idle} {'say' if ' and ' in idle else 'says'} how hands squeeze once they settle, and in "
                              f"--stages {' '.join(self.stages)} none does; add settled, returned or equal-time")
        require_positive(views=self.views)
        for name in ("hands", "objects", "stages", "protocols"):
            if not getattr(self, name):
                raise OptionError(f"--{name} is empty; name at least one")
        begin = time.perf_counter()
        methods = self._methods()
        hands = [load_hand(name) for name in self.hands]
        objects = self._objects(most)
        if clouds := [obj.name for obj in objects if obj.is_cloud]:
            raise ObjectError(f"{', '.join(clouds)}: bare point clouds cannot be simulated; give meshes")
        further = {REFINED: (BEST, *TOP), SETTLED: (SETTLED_BEST,)}
        stages = tuple(name for stage in self.stages for name in (stage, *further.get(stage, ())))
        config = BenchmarkConfig(
            num=self.num, stages=stages, protocols=tuple(protocol(p) for p in self.protocols), seed=self.seed, view=self.view,
            views=self.views, device=self.device, contact_quality=self.contact_quality, mass=self.mass,
            constraints=Constraints(margin=self.margin, max_force=self.max_force))
        with progress_bar("pairs", self.json) as progress:
            rows = benchmark(hands, objects, methods, config, progress)
        if not rows:
            raise OptionError(f"none of {', '.join(m.name for m in methods)} knows any of {', '.join(h.name for h in hands)}")
        seconds = time.perf_counter() - begin
        if self.json:
            print_json({
                "methods": [method.name for method in methods], "weights": self.weights or "default",
                "objects": [obj.name for obj in objects], "num": self.num,
                "view": self.view, "views": self.views, "seed": self.seed, "seconds": round(seconds, 1),
                "rows": [row.to_dict() for row in rows],
            })
            return 0
        columns = ["grasps", "stage", "hand", "n", *rows[0].success, *(f"{label} trials" for label in rows[0].trials_held),
                   "fingers", "shift [mm]", "turn [deg]", "diversity", "ROC area", "candidates", "optimiser [%]", "ms a grasp",
                   *rows[0].contact_quality]
        say(self._title(len(objects)) + "; success, and trials held where a grasp has several, in % of the n grasps asked for, "
            "those that a method did not return included, with 95 % intervals; the average is the mean over hands; for each "
            "protocol fingers in contact (grasps with all of them) in %, and ROC area of the score; candidates made for each "
            "pair\n")
        for line in [columns, ["---"] * len(columns), *map(cells, rows)]:
            say("| " + " | ".join(map(str, line)) + " |")
        say(f"\n{seconds:.0f} s")
        return 0

    def _title(self, n_objects: int) -> str:
        title = f"{self.num} candidates of each hand on each of {n_objects} objects"
        if self.weights is not None:
            title = f"weights '{self.weights}', {title}"
        if self.view != "whole":
            title += f", view '{self.view}'"
        return title + (f", {self.views} views" if self.views > 1 else "")

    def _objects(self, most: int | None) -> list[ObjectModel]:
        """The objects, or the first of them, loaded."""
        from dro_grasp.objects.catalogue import SCALES, load_object, processed_objects, resolve_objects

        if self.dexgraspbench is None:
            return [load_object(name) for name in resolve_objects(list(self.objects))[:most]]
        scaled = [(folder, scale) for folder in processed_objects(self.dexgraspbench) for scale in SCALES]
        return [load_object(folder, scale=scale) for folder, scale in scaled[:most]]

    def _methods(self) -> list[Method]:
        """The methods that were named, or the network and its controls."""
        from dro_grasp.compare.methods import MethodOptions, make_method
        from dro_grasp.training.data.bundle.training_file import load_bundle

        names = self.methods
        if not names:
            controls = ("start", "optimiser", *(("mean-grasp", "mean-grasp-chosen") if self.bundle is not None else ()))
            names = ("auto", *(controls if self.controls else ()))
        bundle = None if self.bundle is None else load_bundle(self.bundle)
        options = MethodOptions(self.weights, self.device, self.temperature, bundle, self.candidates, self.least_confidence)
        return [make_method(name, options) for name in dict.fromkeys(names)]


def cells(row: Row) -> list[object]:
    """A row's cells for people."""
    shares = (*row.success.values(), *row.trials_held.values())
    rates = [f"{100 * p:.1f} [{100 * low:.0f}-{100 * high:.0f}]" for p, low, high in shares]
    fingers = " / ".join(f"{100 * share:.0f} ({100 * everyone:.0f})" for share, everyone in row.fingers.values())
    areas = " / ".join("-" if math.isnan(area) else f"{area:.2f}" for area in row.ranking.values())
    parts = " + ".join(f"{1e3 * seconds:.0f} {name}" for name, seconds in row.seconds.items())
    n = row.asked if row.returned == row.asked else f"{row.asked} ({row.returned} returned)"
    return [
        row.grasps, row.stage, row.hand, n, *rates, fingers, f"{1e3 * row.displacement:.1f}",
        f"{math.degrees(row.rotation):.1f}", f"{row.diversity:.3f}", areas, f"{row.candidates:.0f}",
        f"{100 * row.optimised:.0f}", parts, *(f"{mean:.3g}" for mean in row.contact_quality.values()),
    ]
