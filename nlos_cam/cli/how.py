"""How `render` renders: the options of surface, radiometry and accuracy, and the scene and setting that they make."""

from dataclasses import replace
from typing import Annotated, Any

import typer
from nlos_calibration.rig import first_problem
from pydantic import ValidationError

from nlos_cam.render.accuracy import Accuracy, accuracy_named
from nlos_cam.render.accuracy_search import choose
from nlos_cam.render.effects import EFFECTS, Effects
from nlos_cam.render.material import Material
from nlos_cam.render.scene import Scene

Stop = Annotated[str | None, typer.Option("--accuracy", help="draft, standard (the default), fine or reference.")]
MaxError = Annotated[
    float | None, typer.Option("--max-error", help="Cheapest accuracy whose peak intensities are within this share.")
]
MaxSeconds = Annotated[float | None, typer.Option("--max-seconds", help="Most accurate that takes no longer.")]
BeamsPerCell = Annotated[int | None, typer.Option("--beams-per-cell", help="Beams along each axis of a map cell.")]
EffectNames = Annotated[
    str, typer.Option("--effects", help=f"auto: what the scene calls for. Or exactly these: {', '.join(EFFECTS)}.")
]
Backend = Annotated[str, typer.Option("--backend", help="cpu, torch (on the CPU) or cuda.")]
RadiometryName = Annotated[str | None, typer.Option("--radiometry", help="paper (S1 to S5) or lambertian.")]
MaterialKind = Annotated[str | None, typer.Option("--material", help="lambertian, phong or retroreflective.")]
Specular = Annotated[float | None, typer.Option("--specular", help="Share of the albedo that a lobe takes.")]
Exponent = Annotated[float | None, typer.Option("--exponent", help="Of the lobe's cosine: the larger, the narrower.")]
Albedo = Annotated[
    str | None, typer.Option("--albedo", help="One number, or three with commas between: red,green,blue.")
]
PulseNs = Annotated[float | None, typer.Option("--pulse-ns", help="Full width of the laser's pulse at half height.")]


def scene_of(bare: Scene, material: dict[str, Any], options: dict[str, Any]) -> Scene:
    """A scene with those of the options that were given (not None): fields of Material, and of Scene.

    Raises typer.BadParameter or SceneError with the field, the value and the range.
    """
    given = {name: value for name, value in material.items() if value is not None}
    if isinstance(text := given.get("albedo"), str):
        given["albedo"] = _numbers(text)
    if given:
        try:
            bare = replace(bare, surface=Material(**given).surface)
        except ValidationError as error:
            raise typer.BadParameter(first_problem(error)) from error
    return replace(bare, **{name: value for name, value in options.items() if value is not None})


def _numbers(text: str) -> float | tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(f"albedo {text!r} is not a number, nor three with commas between") from error
    return values[0] if len(values) == 1 else values


def effects_of(text: str) -> Effects:
    """What `--effects` names."""
    return "auto" if text == "auto" else [name for name in text.split(",") if name]


def accuracy_of(
    stop: str | None,
    max_error: float | None,
    max_seconds: float | None,
    beams_per_cell: int | None,
    scene: Scene,
    effects: Effects,
    backend: str,
) -> Accuracy:
    """The setting of a stop, or the one that keeps a bound. Raises typer.BadParameter where both are given."""
    if max_error is None and max_seconds is None:
        setting = accuracy_named(stop or "standard")
        return setting if beams_per_cell is None else replace(setting, beams_per_cell=beams_per_cell)
    if stop is not None or beams_per_cell is not None:
        raise typer.BadParameter(
            "--max-error and --max-seconds choose the accuracy: leave out --accuracy and --beams-per-cell"
        )
    return choose(scene, max_error, max_seconds, effects, backend).accuracy
