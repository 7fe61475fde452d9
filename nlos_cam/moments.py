"""What the loop shows: a moment of each step, and the last one again while the camera stalls."""

from collections.abc import Callable
from dataclasses import replace

from nlos_cam.frame_reader import FrameReader
from nlos_cam.frames import Frame
from nlos_cam.live_report import DELIVERY
from nlos_cam.processing import Step
from nlos_cam.reconstruct import Clock
from nlos_cam.thermometer import Thermometer
from nlos_cam.verdict import Verdict
from nlos_cam.view.viewer import Moment, Viewer


class Moments:
    """Makes moments of steps, and shows them; the last one again while the camera stalls."""

    def __init__(
        self,
        viewer: Viewer,
        dropped: Callable[[], int],
        reader: FrameReader,
        thermometer: Thermometer,
        clock: Clock,
    ) -> None:
        self._viewer, self._dropped, self._reader = viewer, dropped, reader
        self._thermometer, self._clock = thermometer, clock
        self._last: Moment | None = None

    def show(self, step: Step) -> Moment:
        """Of one step, as it is shown."""
        stages_s = {**self._delivery_s(step), **step.stages_s}
        self._last = moment = Moment(
            step.frame,
            step.reconstruction,
            step.published_s,
            self._age_s(step.frame, step.published_s),
            step.difference,
            step.warnings,
            step.verdict,
            step.check,
            stages_s,
            self._dropped(),
            self._thermometer.celsius,
        )
        self._viewer.show(moment)
        return moment

    def stalled(self) -> None:
        """Show the last moment again, as old as it is; none, where there was none."""
        if self._last is not None:
            now_s = self._clock()
            age_s, verdict = self._age_s(self._last.frame, now_s), Verdict.STALLED
            again = replace(self._last, published_s=now_s, latency_s=age_s, verdict=verdict, dropped=self._dropped())
            self._viewer.show(again)

    def _delivery_s(self, step: Step) -> dict[str, float]:
        return {} if step.arrived_s is None else {DELIVERY: self._age_s(step.frame, step.arrived_s)}

    def _age_s(self, frame: Frame, now_s: float) -> float:
        return now_s - frame.timestamp_s - self._reader.offset_s
