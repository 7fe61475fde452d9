"""Second reader of recordings: librealsense's own playback, to compare the built-in reader with."""

import gc
import queue
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from nlos_cam.camera import (
    FORMATS,
    ClockUnwrap,
    FrameSynchronizer,
    Sample,
    find_streams,
    frame_in_si,
    intrinsics_of,
    load_sdk,
    sample_from_sdk,
)
from nlos_cam.camera.session import read_settings
from nlos_cam.frames import Frame

CAPACITY = 24
"""Samples between the SDK's thread, which waits while they are full, and ours."""
POLL_S = 0.05
TIMEOUT_S = 30.0


class SdkReplay:
    """Iterable over the frames of a .bag as librealsense plays it, with the built-in reader's
    counters.
    """

    def __init__(self, path: Path) -> None:
        self.arrived: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self.incomplete = 0
        self.dropped = 0
        self._path = path
        self._sdk = load_sdk()

    def __iter__(self) -> Iterator[Frame]:
        playback = self._sdk.context().load_device(str(self._path)).as_playback()
        playback.set_real_time(False)
        sensor, profiles = find_streams(playback)
        settings = read_settings(sensor)
        intrinsics = intrinsics_of(profiles["depth"])
        pairing = FrameSynchronizer((intrinsics.height, intrinsics.width))
        for sample in self._samples(playback, sensor, list(profiles.values())):
            found = pairing.add(sample)
            if found:
                yield frame_in_si(found, settings["depth_units"], intrinsics, settings)
        pairing.finish()
        self.counts = pairing.counts
        self.incomplete = pairing.incomplete
        self.dropped = pairing.dropped

    def _samples(self, playback: Any, sensor: Any, profiles: list[Any]) -> Iterator[Sample]:
        inbox: queue.Queue[Sample] = queue.Queue(CAPACITY)
        clocks = {stream: ClockUnwrap() for stream in FORMATS}

        def take(frame: Any) -> None:
            sample = sample_from_sdk(frame)
            if frame.get_frame_timestamp_domain().name == "hardware_clock":
                unwrapped_s = clocks[sample.stream].add(sample.timestamp_s)
                sample = replace(sample, timestamp_s=unwrapped_s)
            inbox.put(sample, timeout=TIMEOUT_S)

        sensor.open(profiles)
        sensor.start(take)
        stopped = self._sdk.playback_status.stopped
        deadline_s = time.monotonic() + TIMEOUT_S
        try:
            while True:
                # Asked before the queue: once stopped, whatever is to come is in the queue already.
                # It has the same status before its first frame.
                has_ended = playback.current_status() == stopped and self.arrived.total() > 0
                try:
                    sample = inbox.get(timeout=POLL_S)
                except queue.Empty:
                    if has_ended:
                        return
                    assert time.monotonic() < deadline_s, f"{self._path} gave no frame"
                    continue
                deadline_s = time.monotonic() + TIMEOUT_S
                self.arrived[sample.stream] += 1
                yield sample
        finally:
            sensor.stop()
            sensor.close()
            gc.collect()
