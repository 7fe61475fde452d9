"""Material of a hidden surface: albedo and BRDF.

A BRDF is given relative to a perfectly diffuse surface (pi f_r in the rendering equation), as a
function of three cosines: incoming to normal, outgoing to normal, incoming to outgoing.
"""

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from nlos_calibration import Record
from numpy.typing import NDArray
from pydantic import Field, field_validator
from pydantic_core import PydanticCustomError

from nlos_cam.errors import SceneError

MAX_GIVEN_BACK = 1.0001
"""Largest sum of a BRDF's parts: all of the light, with room for a sum of rounded parts."""


class Brdf(NamedTuple):
    """Diffuse part and one lobe, relative to a white Lambertian surface."""

    diffuse: float
    specular: float
    """Share of the light in the lobe."""
    exponent: float
    mirrored: bool
    """True for a lobe about the mirror direction, False for one about the incoming light."""

    @property
    def gain(self) -> float:
        """Value of the lobe along its axis."""
        # Modified Phong (Lafortune and Willems 1994): (n + 2) / (2 pi) cos^n integrates to at most
        # 1 with the cosine, and pi times it is relative to a diffuse surface.
        return self.specular * (self.exponent + 2) / 2

    def __call__(self, cos_in: Any, cos_out: Any, cos_between: Any) -> Any:
        """Return the value for three cosines: incoming and outgoing to normal, and in between."""
        axis = 2 * cos_in * cos_out - cos_between if self.mirrored else cos_between
        # (x + |x|) / 2 is max(x, 0) on scalars and arrays alike.
        return self.diffuse + self.gain * ((axis + abs(axis)) / 2) ** self.exponent


def phong(diffuse: float, specular: float, exponent: float) -> Brdf:
    """Return a lobe about the mirror direction, normalized: diffuse + specular <= 1 never gains
    energy.
    """
    return Brdf(diffuse, specular, exponent, mirrored=True)


def retroreflective(diffuse: float, specular: float, exponent: float) -> Brdf:
    """Return a lobe about the direction of the incoming light, normalized as in `phong`."""
    return Brdf(diffuse, specular, exponent, mirrored=False)


class Material(Record):
    """BRDF by name, for scene files and the command line."""

    kind: Literal["lambertian", "phong", "retroreflective"] = "lambertian"
    specular: float = Field(default=0.5, ge=0, le=1)
    """Share of the albedo in the lobe; the rest is diffuse. Ignored for a Lambertian surface."""
    exponent: float = Field(default=20.0, ge=1, le=2000)
    """Exponent of the lobe's cosine: 20 is a lobe of about 30 degrees full width, 200 of about
    10.
    """
    albedo: float | tuple[float, float, float] = 1.0
    """One number, or three for red, green and blue."""

    @field_validator("albedo", mode="before")
    @classmethod
    def _check_albedo(cls, albedo: object) -> object:
        values = albedo if isinstance(albedo, list | tuple) else (albedo,)
        numbers = [
            value
            for value in values
            if isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1
        ]
        wanted = 3 if values is albedo else 1
        if len(numbers) != len(values) or len(values) != wanted:
            raise PydanticCustomError(
                "albedo", "must be one number from 0 to 1, or three for red, green and blue"
            )
        return albedo

    @property
    def surface(self) -> "Surface":
        """Surface with this material all over."""
        return Surface(np.asarray(self.albedo, np.float64), self.brdf)

    @property
    def brdf(self) -> Brdf | None:
        """BRDF; None is Lambertian."""
        if self.kind == "lambertian":
            return None
        return {"phong": phong, "retroreflective": retroreflective}[self.kind](
            1 - self.specular, self.specular, self.exponent
        )


@dataclass(frozen=True)
class Surface:
    """Albedo and BRDF of a hidden object. Raises SceneError for an albedo of another shape or
    outside 0 to 1, and for a BRDF that gives back more light than it gets.
    """

    albedo: NDArray[np.floating[Any]] | float = 1.0
    """(), (3,), or for each cell of the depth map (rows, columns) or (rows, columns, 3)."""
    brdf: Brdf | None = None
    """None is Lambertian."""

    def __post_init__(self) -> None:
        albedo = np.asarray(self.albedo)
        if albedo.dtype.kind not in "fiub":
            raise SceneError(f"albedo is {self.albedo!r:.40}: give numbers from 0 to 1")
        if albedo.size == 0 or albedo.ndim > 3 or (albedo.ndim in {1, 3} and albedo.shape[-1] != 3):
            raise SceneError(
                f"albedo has shape {albedo.shape}: give one number, three, or one or three for each"
                " cell"
            )
        if not (np.isfinite(albedo).all() and albedo.min() >= 0 and albedo.max() <= 1):
            raise SceneError(
                f"albedo ranges from {albedo.min():g} to {albedo.max():g}: it must be from 0 to 1"
            )
        if self.brdf is not None:
            _check_brdf(self.brdf)

    @property
    def colored(self) -> bool:
        """True if the albedo has three channels."""
        return np.ndim(self.albedo) in {1, 3}

    def over(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the albedo (rows, columns, channels) of a depth map's cells. Raises SceneError if
        shapes disagree.
        """
        albedo = np.asarray(self.albedo, np.float64)
        if not self.colored:
            albedo = albedo[..., None]
        if albedo.ndim == 3 and albedo.shape[:2] != shape:
            raise SceneError(
                f"albedo has {albedo.shape[:2]} cells but the depth map has {shape}: use one shape"
            )
        return np.broadcast_to(albedo, (*shape, albedo.shape[-1]))


def _check_brdf(brdf: Brdf) -> None:
    diffuse, specular, exponent, _ = brdf
    if not (diffuse >= 0 and specular >= 0 and diffuse + specular <= MAX_GIVEN_BACK):
        raise SceneError(
            f"a BRDF gives back {diffuse:g} diffusely and {specular:g} in its lobe: both must be at"
            " least 0, and their sum at most 1"
        )
    if not 0 < exponent < np.inf:
        raise SceneError(f"a BRDF's exponent is {exponent:g}: it must be finite and above 0")


def without_lobe(brdf: Brdf) -> float:
    """Return the value that stands for a BRDF that is left out: that of a matt surface which gives
    back as much light.
    """
    return brdf.diffuse + brdf.specular


def brdf_range(brdf: Brdf) -> tuple[float, float]:
    """Return the smallest and the largest value of a BRDF over the hemisphere, mirror and backward
    lobes included.
    """
    theta = np.radians(np.linspace(0, 85, 18))
    cos_in, cos_out, turn = np.meshgrid(
        np.cos(theta), np.cos(theta), np.linspace(0, np.pi, 13), indexing="ij"
    )
    # Spherical law of cosines for two directions at polar angles in and out, `turn` apart in
    # azimuth.
    cos_between = cos_in * cos_out + np.sqrt((1 - cos_in**2) * (1 - cos_out**2)) * np.cos(turn)
    value = np.broadcast_to(brdf(cos_in, cos_out, cos_between), cos_in.shape)
    return float(value.min()), float(value.max())
