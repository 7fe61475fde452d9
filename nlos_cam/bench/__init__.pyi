__all__ = [
    "FORECAST_SCATTER_IOU",
    "MAIN",
    "MANIFEST",
    "TEST_IOU",
    "WEIGHTS",
    "Bench",
    "BenchEdit",
    "BenchRecord",
    "ForecastRecord",
    "StationRecord",
    "check_new",
    "edit_bench",
    "is_bench",
    "load_bench",
    "load_bench_record",
    "station_folder",
    "write_file",
    "write_weights",
]

from .edit import TEST_IOU, BenchEdit, check_new, edit_bench, write_file, write_weights
from .folder import Bench, load_bench
from .record import (
    FORECAST_SCATTER_IOU,
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
