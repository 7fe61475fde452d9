__all__ = [
    "MAIN",
    "MANIFEST",
    "TEST_IOU",
    "WEIGHTS",
    "Bench",
    "BenchEdit",
    "BenchRecord",
    "ForecastRecord",
    "ServingNetworks",
    "StationRecord",
    "check_new",
    "edit_bench",
    "iou_in_use",
    "is_bench",
    "load_bare_wall",
    "load_bench",
    "load_bench_record",
    "load_serving",
    "station_folder",
    "weights_verdict",
    "write_weights",
]

from .edit import (
    TEST_IOU,
    BenchEdit,
    check_new,
    edit_bench,
    iou_in_use,
    write_weights,
)
from .folder import Bench, load_bare_wall, load_bench
from .record import (
    MAIN,
    MANIFEST,
    WEIGHTS,
    BenchRecord,
    ForecastRecord,
    StationRecord,
    is_bench,
    load_bench_record,
    station_folder,
)
from .serving import ServingNetworks, load_serving, weights_verdict
