__all__ = [
    "BACKGROUND_BELOW_V",
    "BLACK_V",
    "GOOD_IOU",
    "MIN_V",
    "SHIPPED",
    "SIMULATION_ONLY",
    "SMALLER_IS_BETTER",
    "SMALLEST_SPREAD",
    "Answer",
    "CellNormal",
    "CheckpointRecord",
    "DirectNetwork",
    "Preprocess",
    "Reconstructor",
    "UncertaintyModel",
    "accuracy_mean_abs",
    "accuracy_within_2_percent",
    "ask",
    "brightness",
    "channel_statistics",
    "channels_of",
    "color_metrics",
    "cut_silhouette",
    "export_folder",
    "foreground_rmse_mm",
    "lift_edges",
    "load_network",
    "load_pipeline",
    "load_reconstructor",
    "load_record",
    "load_uncertainty_model",
    "load_uncertainty_network",
    "quality_features",
    "shipped_folder",
    "silhouette_iou",
    "split_and_stack",
    "surface",
    "weights_folder",
]

from .checkpoint import load_network, load_pipeline
from .direct import CellNormal, DirectNetwork, channels_of
from .export import export_folder
from .inference import (
    Answer,
    Reconstructor,
    UncertaintyModel,
    ask,
    load_reconstructor,
    load_uncertainty_model,
)
from .metrics import (
    BACKGROUND_BELOW_V,
    BLACK_V,
    MIN_V,
    SMALLER_IS_BETTER,
    accuracy_mean_abs,
    accuracy_within_2_percent,
    brightness,
    color_metrics,
    foreground_rmse_mm,
    silhouette_iou,
    surface,
)
from .pipeline import (
    SMALLEST_SPREAD,
    Preprocess,
    channel_statistics,
    cut_silhouette,
    lift_edges,
    split_and_stack,
)
from .quality import GOOD_IOU, quality_features
from .records import (
    SHIPPED,
    SIMULATION_ONLY,
    CheckpointRecord,
    load_record,
    shipped_folder,
    weights_folder,
)
from .uncertainty_network import load_uncertainty_network
