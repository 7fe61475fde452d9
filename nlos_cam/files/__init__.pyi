__all__ = [
    "CHECKSUMS",
    "DISK_ERRORS",
    "TENSOR_LIMIT",
    "TEXT_LIMIT",
    "FileBusyError",
    "OutputExistsError",
    "atomic_directory",
    "atomic_file",
    "atomic_files",
    "cache_folder",
    "checksums_of",
    "claim",
    "damaged_files",
    "describe",
    "is_claimed",
    "load_cached",
    "program_commit",
    "program_name",
    "read_arrays",
    "read_bounded",
    "read_checked",
    "read_hdf5",
    "read_hdf5_text",
    "read_toml",
    "replaced_folder",
    "reservations",
    "with_commit",
    "write_checked",
]

from .atomic import atomic_directory, atomic_file, atomic_files
from .cache import cache_folder, load_cached
from .checksums import CHECKSUMS, checksums_of, damaged_files, read_checked, write_checked
from .claims import DISK_ERRORS, claim, is_claimed, replaced_folder, reservations
from .errors import FileBusyError, OutputExistsError
from .hdf5 import read_hdf5, read_hdf5_text
from .program import program_commit, program_name, with_commit
from .reading import (
    TENSOR_LIMIT,
    TEXT_LIMIT,
    describe,
    read_arrays,
    read_bounded,
    read_toml,
)
