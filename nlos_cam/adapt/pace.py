"""Pace of a machine: how many objects it renders a second, and on how many samples it trains."""

import time
from collections.abc import Callable
from math import ceil

import torch
from nlos_models import training

from nlos_cam import dataset as data
from nlos_cam.adapt.job import OBJECTS, Adaptation, data_plan, start_network
from nlos_cam.adapt.plan import BATCH, FIRST_OBJECTS, Pace, Stage

PACE_OBJECTS = 200
PACE_OBJECTS_EACH = 50
"""Objects that the pace is measured on: at least these, and these for each process that renders.
Many processes bring their first pieces at the same moment, whatever these took."""
PACE_STEPS = 12
NOTES_EACH = 3
"""Fewest calls of `on_progress` for each process that a pace is measured by."""


def measure_pace(job: Adaptation, on_progress: Callable[[int, int], None]) -> Pace:
    """Measure rendering on the first objects, which are kept, then training on maps of noise."""
    plan = data_plan(job, job.seed, expected=True, off_record=True)
    # before the objects: it refuses start weights that cannot be trained on
    step = _probe_step(job, data.map_noise(plan))
    # the first objects compile kernels
    folder = job.folder / OBJECTS
    data.build_dataset(plan, data.SHARD, folder, workers=1, on_progress=data.ignore, farm=job.farm)

    done_at: list[tuple[int, float]] = []

    def note(done: int, total: int) -> None:
        done_at.append((done, time.perf_counter()))
        on_progress(done - data.SHARD, total - data.SHARD)

    # Objects that were there when a measurement was killed say nothing about the pace. A cluster
    # knows its processes once it has rendered.
    count = data.SHARD
    while len(done_at) <= NOTES_EACH * job.renderers:
        done_at.clear()
        objects = max(PACE_OBJECTS, PACE_OBJECTS_EACH * job.renderers)
        count += data.SHARD * ceil(objects / data.SHARD)
        data.build_dataset(
            plan, count, folder, workers=job.workers, on_progress=note, farm=job.farm
        )

    # Workers take seconds to start, once for all objects: the pace counts from the first piece of
    # each on. The first note says how many objects were there before.
    first, first_s = done_at[job.renderers]
    last, last_s = done_at[-1]

    step()  # the first one allocates
    start_s = time.perf_counter()
    for _ in range(PACE_STEPS):
        step()
    seconds = time.perf_counter() - start_s
    return Pace(
        objects_per_s=(last - first) / (last_s - first_s),
        samples_per_s=PACE_STEPS * BATCH / seconds,
    )


def _probe_step(job: Adaptation, noise: training.MapNoise) -> Callable[[], None]:
    """Return a training step on made-up maps, which leaves the start weights as they are."""
    recipe = _probe_recipe()
    network, _ = start_network(recipe, job.start_folder)
    fabric = training.open_fabric(recipe, accelerator=job.accelerator)
    network = network.to(fabric.device).train()
    optimizer = torch.optim.AdamW(network.parameters(), 1e-12)
    maps = torch.randn(BATCH, 2, 64, 80, device=fabric.device).half()
    batch = training.NormalBatch(maps, torch.zeros_like(maps[:, 0, :, :64]), maps[:, 1].abs())

    def step() -> None:
        # in the training's own precision: bfloat16 is several times as fast where a CPU has it
        with fabric.autocast():
            # another noise, wall and offset for each object, which take as long as a small network
            loss = training.step_error(recipe, network.normal, network.logits, batch, noise)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        float(loss.detach())  # waits for a GPU, which would count steps that it has not done

    return step


def _probe_recipe() -> training.DirectRecipe:
    return Stage(minutes=1.0, objects=FIRST_OBJECTS, epochs=1, steps=10).recipe()
