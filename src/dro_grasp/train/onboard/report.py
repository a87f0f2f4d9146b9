"""Report on the onboarding of a hand, as one web page."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from dro_grasp.compare.stages import BEST, RAW, REFINED, RETURNED
from dro_grasp.files import command
from dro_grasp.hands.library import load_hand, locate_hand
from dro_grasp.objects.catalogue import load_object, resolve_objects
from dro_grasp.pictures.sheets import draw_grasps
from dro_grasp.pictures.web_page import image, table, write_page
from dro_grasp.predict.config import AUTO, GraspRequest
from dro_grasp.predict.predictor import GraspPredictor
from dro_grasp.predict.problem import GraspProblem
from dro_grasp.predict.stages import evaluate
from dro_grasp.train.onboard.steps import DATA, PICTURE, REPORT, STRICT, Onboarded

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
    before, after = (done.rate(step, REFINED, STRICT) for step in ("before", "after"))
    best = done.rate("after", BEST, STRICT)
    returned = " and ".join(
        f"{done.rate(step, RETURNED, STRICT):.0%} {step} ({done.optimised(step):.0%} of them made by the optimiser)"
        for step in ("before", "after"))
    minutes = sum(step["seconds"] for step in done.steps.values()) / 60
    return (f"<p>On held-out objects, {before:.0%} of the refined grasps pass protocol <i>strict</i> before fine-tuning, and "
            f"{after:.0%} after fine-tuning on {done.steps['training']['grasps']:,} grasps of this hand; of the best quarter "
            f"by score, {best:.0%} pass. Of the grasps that <i>generate</i> returns, {returned} pass. All steps took "
            f"{minutes:.0f} minutes.</p>" + "".join(f"<p><b>{html.escape(line)}</b></p>" for line in done.verdict()))


def _rates(done: Onboarded) -> str:
    rows = []
    for step in ("before", "after"):
        for row in done.steps[step]["rows"]:
            rates = [f"{100 * p:.0f} % [{100 * low:.0f}-{100 * high:.0f}]" for p, low, high in row["success"].values()]
            touching, all_touch = (100 * share for share in row["fingers"][STRICT])
            rows.append([step, STAGES[row["stage"]], row["asked"], row["returned"], *rates, f"{touching:.0f} ({all_touch:.0f})",
                         f"{100 * row['optimised']:.0f} %", f"{row['diversity']:.2f}"])
    labels = list(done.steps["after"]["rows"][0]["success"])
    return table(["weights", "grasps", "asked", "returned", *labels, "fingers [%]", "by the optimiser", "diversity"], rows) + (
        "<p class=note>Success rates of the grasps asked for, with 95 % intervals. dro is the paper's protocol and lenient; "
        "strict also limits penetration and how far closing may push the object. Fingers: the share of the hand's that touch "
        "the object, and in parentheses of the grasps with all of them. The network's rows are what fine-tuning improves. "
        "<i>generate</i> keeps the best of four of the network's candidates by score, as the row <i>best quarter</i> does, and "
        "asks the optimiser for others where the score does not trust these: slower, and less needed the better the network "
        "is. <i>generate --source network</i> does without.</p>")


def _drawn(done: Onboarded) -> str:
    config, asked = done.config, done.config.grasps_drawn
    hand, predictor = load_hand(done.hand), GraspPredictor(done.weights, config.device, config.predictor)
    parts = []
    for name in resolve_objects(list(config.held_out))[: config.objects_drawn]:
        obj = load_object(name)
        path = done.folder / f"{Path(name).stem}.png"
        problem = GraspProblem(hand, obj)
        made = predictor.run(problem, GraspRequest(asked, source=config.source))
        draw_grasps(hand, obj, evaluate(problem, made.grasps, "strict"), path)
        by_optimiser, short = made.origin.count("optimiser"), ""
        if len(made.grasps) < asked:
            short = f"; {len(made.grasps)} of the {asked} asked for were found"
        parts.append(image(path.read_bytes(), f"grasps of {name}")
                     + f"<p class=note>{html.escape(name)}: {by_optimiser} of {len(made.grasps)} made by the optimiser{short}"
                       "</p>")
    return "".join(parts)


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
        "dro-grasp evaluate grasps.parquet --protocol strict",
        "dro-grasp export grasps.parquet --format isaac_grasp --output grasps.yaml --only-successful",
        command("dro-grasp", "dataset", "report", done.folder / DATA, "--output", "data.html"),
    ]
    return f"<pre>{html.escape(chr(10).join(lines))}</pre>"
