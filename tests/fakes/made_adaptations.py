"""Folders of adaptations whose plan, of a few steps, is there already."""

import shutil
from hashlib import sha256
from pathlib import Path

from nlos_calibration import Rig
from nlos_models import shipped_folder

from nlos_cam.adapt import NETWORK_FILE, Adaptation, Plan, Stage, calibration_spread
from nlos_cam.adapt.plan import Pace
from nlos_cam.files import CHECKSUMS, checksums_of
from nlos_cam.render import RENDERING_VERSION, SensorModel

NETWORK = "checkpoint.json", NETWORK_FILE, "network.onnx"


def job_in(folder: Path, rig: Rig) -> Adaptation:
    """Return a job whose plan, of a few steps, is there already."""
    spread = calibration_spread(None)
    folder.mkdir()
    stage = Stage(minutes=1.0, objects=300, epochs=2, steps=3)
    Plan(
        rendering_version=RENDERING_VERSION,
        rig_checksum=rig.checksum,
        start=sha256((shipped_folder() / NETWORK_FILE).read_bytes()).hexdigest(),
        spread=spread,
        sensor=SensorModel(),
        seed=0,
        pace=Pace(objects_per_s=1.0, samples_per_s=1.0),
        stages=(stage,),
    ).save(folder)
    return Adaptation(rig, spread, folder, workers=1)


def finish_network(folder: Path) -> None:
    """Make the first stage's network the shipped one, as if it had been trained."""
    network = folder / "stage-1" / "network"
    network.mkdir(parents=True)
    sums = checksums_of(shipped_folder())
    for name in NETWORK:
        shutil.copyfile(shipped_folder() / name, network / name)
    lines = [f"{sums[name]}  {name}\n" for name in NETWORK]
    (network / CHECKSUMS).write_text("".join(lines), encoding="utf-8")
