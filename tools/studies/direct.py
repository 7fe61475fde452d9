"""Direct networks side by side, each trained for equal processor seconds:
docs/figures/direct_ablations.json, and the tables of docs/direct.md, which are printed.

And a learning curve over runs of one recipe with other budgets: docs/figures/direct_curve.json,
docs/images/direct_curve.png.

`python tools/studies/direct.py --store DIR --dataset DIR --held-out DIR [--samples N]
[NAME:field=value,...]`: variants of models/recipes/paper-rig-direct.toml, compared with the first.
One thread; results are appended. Variants and --weights NAME=DIR whose names begin with "curve"
make the curve.
"""

import json
import time
from argparse import Namespace
from functools import partial
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import harness
import numpy as np
import torch
from matplotlib.figure import Figure
from nlos_calibration import rig_named
from nlos_models import DirectNetwork, load_network
from nlos_models.training import (
    DirectRecipe,
    MapSet,
    Running,
    first_of,
    load_recipe,
    run,
    train_direct,
)

from nlos_cam.dataset import PackedMaps, open_dataset, open_packed_maps
from nlos_cam.evaluate import (
    TARGETS,
    advantage,
    format_interval,
    over_objects,
    per_object,
    plain,
    rendered_objects,
)

RECIPE = harness.ROOT / "models" / "recipes" / "paper-rig-direct.toml"
PACE_STEPS = 8
NOTES = (
    "Means over objects and their bootstrap 95 % intervals; one run each, seed 0. Differences are"
    " taken object by\nobject; positive is better."
)


def variant(text: str, base: DirectRecipe) -> tuple[str, DirectRecipe]:
    """Return name and recipe of "NAME:field=value,direct.field=value": values as JSON, or plain
    words.
    """
    name, _, changes = text.partition(":")
    fields = dict[str, Any]()
    size = dict[str, Any]()
    for change in filter(None, changes.split(",")):
        key, _, value = change.partition("=")
        try:
            parsed = json.loads(value)
        except json.JSONDecodeError:
            parsed = value
        (size if key.startswith("direct.") else fields)[key.removeprefix("direct.")] = parsed
    fields["direct"] = base.direct.model_dump() | size
    return name, DirectRecipe.model_validate(base.model_dump() | fields)


def pace(recipe: DirectRecipe, source: PackedMaps, held_out: MapSet) -> float:
    """Return the samples per processor second of a few steps of training."""
    marks = list[float]()
    running = Running(on_step=lambda _done, _all: marks.append(time.process_time()))
    short = recipe.model_copy(update={"objects": PACE_STEPS * recipe.batch, "epochs": 1})
    with TemporaryDirectory() as folder:
        train_direct(short, source, first_of(held_out, 1), Path(folder), running)
    return recipe.batch * (len(marks) - 2) / (marks[-1] - marks[1])


def measure(
    name: str, recipe: DirectRecipe, source: PackedMaps, sets: dict[str, MapSet], given: Namespace
) -> dict[str, Any]:
    """Train a variant for some processor seconds, or samples; return its facts and metrics on each
    set, per object.
    """
    rate = pace(recipe, source, sets["held_out"])
    steps = max(10, int(given.samples or rate * given.cpu_seconds) // recipe.batch)
    timed = recipe.model_copy(update={"objects": steps * recipe.batch, "epochs": 1})
    start_s = time.process_time()
    with TemporaryDirectory() as folder:
        network, _ = train_direct(
            timed, source, sets["held_out"], Path(folder), Running(checkpoint_s=1e9)
        )
    spent_s = time.process_time() - start_s
    facts = {"name": name, "objects": len(source), "samples": steps * recipe.batch}
    return facts | _judge(network, source, sets) | {"samples_per_s": rate, "cpu_seconds": spent_s}


def _judge(network: DirectNetwork, source: PackedMaps, sets: dict[str, MapSet]) -> dict[str, Any]:
    """Return the number of parameters, and every metric of every object on each set."""
    values = {
        key: per_object(run(network, maps), maps.image.astype(np.float32), source.plan.box)
        for key, maps in sets.items()
    }
    plain_values = {
        key: {metric: each.tolist() for metric, each in one.items()} for key, one in values.items()
    }
    return {"parameters": sum(p.numel() for p in network.parameters()), "values": plain_values}


def judged(text: str, source: PackedMaps, sets: dict[str, MapSet]) -> dict[str, Any]:
    """Return the facts and metrics of trained weights, NAME=DIR."""
    name, _, folder = text.partition("=")
    network, record = load_network(Path(folder))
    if not isinstance(network, DirectNetwork):
        raise SystemExit(f"{folder} holds no direct network: give another --weights")
    samples = sum(recipe.objects * recipe.epochs for recipe in record.runs)
    facts = {"name": name, "objects": len(source), "samples": samples}
    return facts | _judge(network, source, sets) | {"samples_per_s": None, "cpu_seconds": None}


def extrapolate(rows: list[dict[str, Any]], key: str, wanted: float) -> dict[str, Any]:
    """Fit 1 - IoU = k samples^-a to runs with other budgets; return a and the samples for the
    wanted IoU.

    Intervals by bootstrap over objects, the same ones in all runs: they leave out that another seed
    differs, and that the law may not hold so far away.
    """
    samples = np.log([row["samples"] for row in rows])
    lost = 1 - np.array([row["values"][key]["silhouette_iou"] for row in rows])
    choices = np.random.default_rng(0).integers(0, lost.shape[1], (2000, lost.shape[1]))
    means = np.concatenate([lost.mean(1)[None], lost[:, choices].mean(2).T])
    slope, offset = np.polyfit(samples, np.log(means).T, 1)
    needed = np.exp((np.log(1 - wanted) - offset) / slope)
    limits = [0.025, 0.975]
    return {
        "exponent": [float(-slope[0]), *np.quantile(-slope[1:], limits).tolist()],
        "wanted": wanted,
        "samples": [float(needed[0]), *np.quantile(needed[1:], limits).tolist()],
    }


def draw_curve(rows: list[dict[str, Any]]) -> Figure:
    """Draw the IoU on each set against samples, with intervals and the fitted law."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    samples = np.array([row["samples"] for row in rows])
    for key in rows[0]["values"]:
        each = [
            over_objects({"iou": np.array(row["values"][key]["silhouette_iou"])})["iou"]
            for row in rows
        ]
        values, low, high = (
            np.array([getattr(one, part) for one in each]) for part in ("value", "low", "high")
        )
        axes.errorbar(
            samples,
            values,
            [values - low, high - values],
            marker="o",
            capsize=3,
            label=key.replace("_", " "),
        )
    axes.set(xscale="log", xlabel="samples seen", ylabel="silhouette IoU")
    axes.legend()
    return figure


def as_markdown(rows: list[dict[str, Any]]) -> str:
    """Return the tables of docs/direct.md, one for each test set."""
    parts = [f"# Direct networks: {budget_of(rows)}"]
    for key in rows[0]["values"]:
        first = {metric: np.array(each) for metric, each in rows[0]["values"][key].items()}
        lines = list[list[str]]()
        for row in rows:
            values = {metric: np.array(each) for metric, each in row["values"][key].items()}
            figures = over_objects(values)
            better = plain(advantage(values, first))
            lines.append(
                [
                    row["name"],
                    f"{row['parameters'] / 1e6:.1f}",
                    f"{row['samples_per_s']:.0f}" if row["samples_per_s"] else "",
                    f"{row['samples']}",
                    *(format_interval(figures[metric]) for metric in TARGETS),
                    harness.difference(better["silhouette_iou"]),
                ]
            )
        head = [
            "variant",
            "million parameters",
            "samples/CPU s",
            "samples",
            *TARGETS,
            f"IoU against {rows[0]['name']}",
        ]
        parts += [f"## {key.replace('_', ' ')}", harness.table(head, lines)]
    return "\n\n".join([*parts, NOTES]) + "\n"


def budget_of(rows: list[dict[str, Any]]) -> str:
    """Return the budget that the trained variants share."""
    trained = [row["samples"] for row in rows if row["samples_per_s"]]
    if not trained:
        return "weights as they were given"
    if len(trained) > 1 and len(set(trained)) == 1:
        return f"{trained[0]} samples each"
    return "as many processor seconds of one thread each, with a cosine schedule of its own"


def main(chosen: Namespace) -> None:
    """Train the variants and write the tables after each."""
    with open_packed_maps(chosen.dataset, chosen.store) as source:
        compare(chosen, source)


def compare(chosen: Namespace, source: PackedMaps) -> None:
    """Train the variants on packed maps and write the tables after each."""
    base = load_recipe(RECIPE)
    rig = rig_named("paper-rig")
    sets = {
        "kinds": rendered_objects(rig).maps,
        "unseen": rendered_objects(rig, test="unseen").maps,
        "held_out": open_dataset(chosen.held_out).first(base.held_out),
    }
    torch.set_num_threads(1)  # after rendering, whose threads set the number anew
    path = chosen.out / "figures" / "direct_ablations.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    jobs = [partial(judged, text, source, sets) for text in chosen.weights]
    jobs += [
        partial(measure, *variant(text, base), source, sets, chosen) for text in chosen.variant
    ]
    for job in jobs:
        row = job()
        rows = [*(one for one in rows if one["name"] != row["name"]), row]
        name = row["name"]
        path.write_text(json.dumps(rows), encoding="utf-8")
        figures = {
            key: over_objects({m: np.array(v) for m, v in rows[-1]["values"][key].items()})
            for key in sets
        }
        print(name, row["samples"], row["samples_per_s"], flush=True)
        for key, each in figures.items():
            print(
                "  ",
                key,
                {metric: format_interval(figure) for metric, figure in each.items()},
                flush=True,
            )
    if rows:
        print(as_markdown(rows))
    curve = sorted(
        (row for row in rows if row["name"].startswith("curve")), key=itemgetter("samples")
    )
    if len(curve) > 1:
        fits = {
            key: extrapolate(curve, key, wanted)
            for key, wanted in {"kinds": 0.85, "unseen": 0.72}.items()
        }
        facts = [{key: row[key] for key in ("name", "samples", "objects")} for row in curve]
        harness.write("direct_curve", {"runs": facts, **fits}, chosen.out)
        (chosen.out / "images").mkdir(exist_ok=True)
        draw_curve(curve).savefig(chosen.out / "images" / "direct_curve.png", dpi=110)
        print(fits)


if __name__ == "__main__":
    parser = harness.options(__doc__)
    parser.add_argument("variant", nargs="*")
    parser.add_argument("--weights", action="append", default=[])
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--dataset", type=Path, action="append", required=True)
    parser.add_argument("--held-out", type=Path, required=True)
    parser.add_argument("--cpu-seconds", type=float, default=200.0)
    parser.add_argument("--samples", type=int, help="of each variant, in place of --cpu-seconds")
    parser.add_argument("--out", type=Path, default=harness.DOCS)
    main(parser.parse_args())
