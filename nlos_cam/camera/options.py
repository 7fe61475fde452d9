"""Setting a running sensor's options within their ranges, and reading back what became of it."""

from collections.abc import Mapping
from typing import Any

from nlos_cam.camera.laser_power import Limits

TOLERANCE = 1e-3
NOT_OFFERED = "not offered by this firmware"


class Options:
    """A sensor's options, by the SDK's names. What the SDK refuses becomes a note, never an exception."""

    def __init__(self, sensor: Any, sdk: Any) -> None:
        self._sensor, self._sdk = sensor, sdk

    def limits(self, name: str) -> Limits | None:
        """The range that the firmware tells; None where it tells none."""
        try:
            told = self._sensor.get_option_range(self._option(name))
        except RuntimeError:
            return None
        return Limits(told.min, told.max, told.step if told.step > 0 else 1.0)

    def get(self, name: str) -> float | None:
        """The value now; None where it cannot be read."""
        option = self._option(name)
        try:
            return float(self._sensor.get_option(option)) if self._sensor.supports(option) else None
        except RuntimeError:
            return None

    def put(self, name: str, wanted: float) -> str:
        """Set an option as near as its range allows; what is not as wanted then, empty where all is."""
        option = self._option(name)
        if not self._sensor.supports(option):
            return NOT_OFFERED
        limits = self.limits(name)
        value = limits.nearest(wanted) if limits else wanted
        try:
            self._sensor.set_option(option, value)
        except RuntimeError as error:
            return f"{value:g} was refused ({error})"
        return self.difference(name, wanted)

    def difference(self, name: str, wanted: float) -> str:
        """How the value now differs from what is wanted; empty where it does not."""
        found = self.get(name)
        if found is None:
            return "cannot be read back"
        return "" if abs(found - wanted) <= TOLERANCE else f"{wanted:g} was wanted, {found:g} is read back"

    def put_all(self, wanted: Mapping[str, float]) -> dict[str, str]:
        """Set options in order; what is not as wanted then, by name."""
        notes = {name: self.put(name, value) for name, value in wanted.items()}
        return {name: note for name, note in notes.items() if note}

    def _option(self, name: str) -> Any:
        return getattr(self._sdk.option, name)
