__all__ = [
    "EMPTY",
    "FRAMES_PER_RECORDING",
    "GENERIC",
    "HELD_OUT_OUTLIERS",
    "HELD_OUT_SEED",
    "OBJECTS_PER_RIG",
    "ORDINARY",
    "REQUIRED_ARRAYS",
    "SHAPE_OUTLIERS",
    "SHARD",
    "SHARD_PATTERN",
    "TEST_SEED",
    "TRAINING_OUTLIERS",
    "TRAINING_SEED",
    "BareMaps",
    "BuildReport",
    "Dataset",
    "DatasetPlan",
    "Labelled",
    "Objects",
    "PackedMaps",
    "RigRange",
    "RigSpread",
    "Stimulus",
    "Tracked",
    "build_dataset",
    "build_transients",
    "check_arrays",
    "check_uncertainty_data",
    "draw_outlier",
    "ignore",
    "label_recordings",
    "list_recordings",
    "measured_bare_wall",
    "objects_from_folder",
    "open_dataset",
    "open_packed_maps",
    "outliers_beside",
    "procedural_images",
    "quality_set",
    "ray_farm",
    "read_head",
    "read_labelled",
    "read_maps",
    "render_bare_wall",
    "samples_on_disk",
    "sense_color",
    "sense_object",
    "shard_origin",
    "shard_path",
    "shards_of",
    "uncertainty_sets",
    "untracked",
    "write_shards",
]

from .build import HELD_OUT_SEED, SHARD, TEST_SEED, TRAINING_SEED, BuildReport, build_dataset
from .labelled import (
    FRAMES_PER_RECORDING,
    Labelled,
    label_recordings,
    list_recordings,
    read_labelled,
    write_shards,
)
from .outliers import (
    HELD_OUT_OUTLIERS,
    SHAPE_OUTLIERS,
    TRAINING_OUTLIERS,
    Stimulus,
    draw_outlier,
    outliers_beside,
)
from .packed import PackedMaps, open_packed_maps
from .plan import DatasetPlan, Objects, RigSpread
from .ray_backend import ray_farm
from .reader import Dataset, open_dataset
from .rig_range import OBJECTS_PER_RIG, RigRange
from .samples import (
    Tracked,
    ignore,
    objects_from_folder,
    procedural_images,
    sense_color,
    sense_object,
    untracked,
)
from .shards import (
    REQUIRED_ARRAYS,
    SHARD_PATTERN,
    check_arrays,
    read_head,
    shard_origin,
    shard_path,
    shards_of,
)
from .training_maps import BareMaps, measured_bare_wall, read_maps, render_bare_wall
from .transients import build_transients
from .uncertainty_samples import (
    EMPTY,
    GENERIC,
    ORDINARY,
    check_uncertainty_data,
    quality_set,
    samples_on_disk,
    uncertainty_sets,
)
