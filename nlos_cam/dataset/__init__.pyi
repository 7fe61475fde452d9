__all__ = [
    "EMPTY",
    "FIRST_ARRAYS",
    "FRAMES_EACH",
    "HELD_OUT_SEED",
    "IN_SHAPE",
    "ORDINARY",
    "PARTS",
    "SHARDS",
    "TEST_SEED",
    "TO_JUDGE",
    "TO_LEARN",
    "TRAINING_SEED",
    "BareMaps",
    "Built",
    "Dataset",
    "DatasetPlan",
    "Objects",
    "RigSpread",
    "Stimulus",
    "build_dataset",
    "check_doubt_data",
    "cluster",
    "doubt_sets",
    "measured_bare_wall",
    "objects_of",
    "open_dataset",
    "outlier",
    "procedural_images",
    "read_labelled",
    "read_maps",
    "recordings_in",
    "render_bare_wall",
    "samples_on_disk",
    "sense_colour",
    "sense_object",
    "write_shards",
]

from .build import HELD_OUT_SEED, TEST_SEED, TRAINING_SEED, Built, build_dataset
from .doubt_samples import EMPTY, ORDINARY, check_doubt_data, doubt_sets, samples_on_disk
from .labelled import FRAMES_EACH, read_labelled, recordings_in, write_shards
from .outliers import IN_SHAPE, TO_JUDGE, TO_LEARN, Stimulus, outlier
from .plan import DatasetPlan, Objects, RigSpread
from .ray_backend import cluster
from .reader import Dataset, open_dataset
from .samples import objects_of, procedural_images, sense_colour, sense_object
from .shards import FIRST_ARRAYS, PARTS, SHARDS
from .training_maps import BareMaps, measured_bare_wall, read_maps, render_bare_wall
