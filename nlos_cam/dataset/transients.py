"""Transients beside a dataset's shards: what the lidar's laser and one wide detector measure of
each object, by its seed.
"""

from pathlib import Path

from nlos_cam.dataset.plan import DatasetPlan
from nlos_cam.dataset.samples import OnProgress, coat_of, hidden_object, ignore, scene_of
from nlos_cam.dataset.shards import only_builder
from nlos_cam.transients import render_transient, save_transient

FOLDER = "transients"


def build_transients(
    plan: DatasetPlan, count: int, folder: Path, on_progress: OnProgress = ignore
) -> Path:
    """Write the transients of `count` objects that are not there yet as FOLDER/transients/SEED.hdf5;
    return their folder. Painted objects count by their mean albedo.

    Raises SceneError for an object that cannot be rendered, and FolderBusyError where another
    build uses the folder.
    """
    target = folder / FOLDER
    with only_builder(folder):
        target.mkdir(exist_ok=True)
        for done, seed in enumerate(range(plan.first_seed, plan.first_seed + count), 1):
            path = target / f"{seed:08d}.hdf5"
            if not path.exists():
                depth_m = hidden_object(plan.objects, seed, plan.box)[1]
                rig, model = plan.bench_of(seed)
                coat = coat_of(seed, depth_m, plan.textures)
                scene = scene_of(plan, depth_m, rig, model, coat)
                save_transient(path, render_transient(scene, accuracy=plan.accuracy))
            on_progress(done, count)
    return target
