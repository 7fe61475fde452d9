"""Checksums of the shipped weights, models/nlos_models/weights/*/SHA256SUMS: run it after a change
of the weights.
"""

from pathlib import Path

from nlos_cam.files import CHECKSUMS, write_checked

WEIGHTS = Path(__file__).parents[2] / "models" / "nlos_models" / "weights"
PATTERNS = "*.safetensors", "*.onnx", "checkpoint.json", "doubt.json", "quality.json"


def write_checksums(weights: Path) -> None:
    """Replace the SHA256SUMS of every folder of weights in a folder."""
    for folder in (entry for entry in weights.iterdir() if entry.is_dir()):
        (folder / CHECKSUMS).unlink(missing_ok=True)
        write_checked(
            folder,
            {path.name: path.read_bytes() for pattern in PATTERNS for path in folder.glob(pattern)},
        )


if __name__ == "__main__":
    write_checksums(WEIGHTS)
