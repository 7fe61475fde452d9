"""What is made of each frame of a camera: maps, their difference from the bare wall, warnings, the hidden depth."""

import time
from collections.abc import Callable, Generator, Iterable

from nlos_calibration.errors import CalibrationError
from nlos_models.doubt_inference import Doubter

from nlos_cam.bench import Bench, Look
from nlos_cam.camera.base import Camera
from nlos_cam.frame_reader import Arrival, FrameReader
from nlos_cam.frames import Frame, maps_from_frame
from nlos_cam.live_report import Step
from nlos_cam.map_mean import MapMean
from nlos_cam.physics_check import UNEXPLAINED, Check, Checks, NoChecks
from nlos_cam.reconstruct import Clock, Network, reconstruct
from nlos_cam.sightings import amiss
from nlos_cam.thermometer import Thermometer, thermometer_of
from nlos_cam.verdict import Judge, Limits, Signs

OnFailure = Callable[[Frame, Exception, int], None]
"""Called with a frame that came to no result, why, and how many have in a row; raises to end there."""


def _refuse(frame: Frame, error: Exception, in_a_row: int) -> None:
    del frame, in_a_row
    raise error


class Processing:
    """What is made of a camera's frames, in their order: maps, their difference from the bare wall, the hidden depth.

    Maps are the mean over the last `average` frames. With a doubt network each reconstruction has an uncertainty and a
    verdict, and shows nothing where nothing is hidden. The newest of the `checks`, which whoever goes over the frames
    enters, goes along with each. Raises CalibrationError where the networks eat difference maps and there is no bare
    wall to form them from.
    """

    def __init__(
        self,
        bench: Bench,
        network: Network,
        *,
        eats_difference: bool = False,
        average: int = 1,
        doubter: Doubter | None = None,
        checks: Checks | None = None,
    ) -> None:
        if eats_difference and bench.reference is None:
            raise CalibrationError(
                "these weights eat difference maps: give --wall with a reference (calibrate the wall again)"
            )
        self.bench, self.network, self.doubter = bench, network, doubter
        self._judge = Judge(limits_of(doubter) if doubter else None)
        self.checks = checks or NoChecks()
        self._eats_difference, self._mean = eats_difference, MapMean(average)

    def step(self, arrival: Arrival, clock: Clock, begun_s: float) -> Step:
        """All of it, for one frame that is waited for since `begun_s`."""
        got_s = clock()
        maps = maps_from_frame(arrival.frame)
        mapped_s = clock()
        maps = self._mean.add(maps)
        look = self.bench.look(arrival.frame, maps)
        looked_s = clock()
        corrected = self.bench.corrected(maps)
        eaten = look.difference if self._eats_difference and look.difference else corrected
        reconstruction = reconstruct(eaten, self.bench.rig, self.network, clock, self.doubter)
        stages_s = {"wait": got_s - begun_s, "queue": got_s - arrival.arrived_s}
        stages_s |= {"maps": mapped_s - got_s, "bench": looked_s - mapped_s}
        stages_s |= reconstruction.timings_s
        shown, verdict = self._judge.look(reconstruction, signs_of(arrival.frame, look, self.checks.newest))
        self.checks.offer(arrival.frame.frame_number, corrected, shown.depth_m)
        made = shown, clock(), stages_s, look.difference, look.warnings, verdict
        return Step(arrival.frame, maps, *made, check=self.checks.newest, arrived_s=arrival.arrived_s)


def limits_of(doubter: Doubter) -> Limits:
    """The limits that a doubt network was calibrated with."""
    return Limits(doubter.record.nothing_above, doubter.record.outside_above, UNEXPLAINED)


def signs_of(frame: Frame, look: Look, check: Check | None) -> Signs:
    """What is amiss with a frame itself, with its bench, and with what was made of the last frame that was checked."""
    names = amiss(frame)
    invalid = "blank" in names or "half_invalid" in names
    return Signs("saturated" in names, invalid, look.moved, check)


def read_along(frames: Iterable[Frame], camera: Camera) -> tuple[Iterable[Frame], Thermometer]:
    """The same frames, and the camera's thermometer, read as they pass."""
    thermometer = thermometer_of(camera)
    return thermometer.watch(frames), thermometer


def steps(
    reader: FrameReader,
    processing: Processing,
    clock: Clock = time.time,
    on_failure: OnFailure = _refuse,
    thermometer: Thermometer | None = None,
) -> Generator[Step]:
    """Reconstruct every frame that the reader gives, in order."""
    begun_s, in_a_row = clock(), 0
    for arrival in reader:
        try:
            if thermometer and (celsius := thermometer.at(arrival.frame)):
                processing.bench.look_at(celsius)
            step = processing.step(arrival, clock, begun_s)
        except Exception as error:  # noqa: BLE001  whatever an odd frame leads to, who called decides
            in_a_row += 1
            on_failure(arrival.frame, error, in_a_row)
        else:
            in_a_row = 0
            yield step
        begun_s = clock()
