"""Settings from nlos-cam.toml and the environment, which commands use where an option is not given;
`nlos-cam config`.

Precedence: option, environment variable, nlos-cam.toml in the current folder, then in the user's
folder, default.
"""

import inspect
import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, nullcontext
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from nlos_calibration.errors import CalibrationError
from rich.markup import escape
from rich.table import Table

from nlos_cam.cli.common import Detail, Json, finish, say, say_interrupted, set_detail, show
from nlos_cam.errors import RecordingError, UnknownNameError, did_you_mean
from nlos_cam.files import read_toml

FILE = "nlos-cam.toml"
MAX_PORT = 65535
SAMPLE = "sample"
"""Name of the recording in the package."""
ROS2_RECORD = "metadata.yaml"
"""File in the folder of a bag of ROS 2."""


class Setting(NamedTuple):
    """Row of the table of settings."""

    commands: frozenset[str]
    """Commands that use it; empty for the cache, which all use."""
    default: str | None
    meaning: str


SETTINGS = {
    "camera": Setting(frozenset({"live", "capture", "calibrate", "detect"}), "sim", "CAMERA"),
    "wall": Setting(
        frozenset({"live", "replay", "view", "capture", "detect"}),
        None,
        "--wall, unless another CAMERA is given",
    ),
    "bench": Setting(
        frozenset({"live", "replay", "view", "capture", "evaluate", "detect", "predict"}),
        None,
        "--bench, unless another CAMERA, --wall, --rig or --dataset is given",
    ),
    "weights": Setting(frozenset({"live", "replay", "view", "evaluate"}), None, "--weights"),
    "view_port": Setting(frozenset({"demo", "live", "view"}), None, "--view-port"),
    "cache": Setting(frozenset(), None, "folder for rendered scenes and exported networks"),
}
"""Settings by their key in the file; the environment variable of `camera` is NLOS_CAM_CAMERA."""
PARAMETERS = {"bench": "bench_folder"}
"""Parameters of commands that are not named like their setting."""
DEFAULT = "default"
"""Source of a setting that nobody has made."""


class Value(NamedTuple):
    """Value of a setting, and the place that it comes from."""

    value: str | int | None
    source: str


def variable(name: str) -> str:
    """Return the environment variable of a setting."""
    return f"NLOS_CAM_{name.upper()}"


def read_settings(
    environment: Mapping[str, str] = os.environ,
    folder: Path | None = None,
    user_folder: Path | None = None,
) -> dict[str, Value]:
    """Return every setting. Raises RecordingError for a file that cannot be used, BadParameter for
    a variable.
    """
    values = {name: Value(setting.default, DEFAULT) for name, setting in SETTINGS.items()}

    # from the weakest source to the strongest
    for place in (user_folder or Path(typer.get_app_dir("nlos-cam")), folder or Path()):
        path = place / FILE
        for name, value in _read_file(path).items():
            values[name] = Value(value, str(path))
    for name in SETTINGS:
        source = variable(name)
        if text := environment.get(source):
            values[name] = Value(_port_in(source, text) if name == "view_port" else text, source)
    return values


def _port_in(name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= MAX_PORT):
        raise typer.BadParameter(f"{name} must be a port from 1 to {MAX_PORT} (got {text!r})")
    return int(text)


def _read_file(path: Path) -> dict[str, str | int]:
    """Return the settings in a file, paths made relative to its folder; empty without the file."""
    try:
        if not path.is_file():
            return {}
    except OSError:  # in a home folder that this user may not enter
        return {}
    try:
        content = read_toml(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no TOML text"
        raise RecordingError(f"{path} cannot be read ({reason}): correct or delete it") from error
    return {name: _checked(path, name, value) for name, value in content.items()}


def _checked(path: Path, name: str, value: object) -> str | int:
    if name not in SETTINGS:
        raise RecordingError(
            f"{path}: no setting {name!r}.{did_you_mean(name, SETTINGS)} Choose from"
            f" {', '.join(SETTINGS)}"
        )
    if name == "view_port":
        if isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MAX_PORT:
            return value
        raise RecordingError(
            f"{path}: view_port must be a whole number from 1 to {MAX_PORT} (got {value!r:.40})"
        )
    if not isinstance(value, str) or not value:
        raise RecordingError(f"{path}: {name} must be a text in quotes (got {value!r:.40})")
    scheme, colon, rest = _split_scheme(value) if name == "camera" else ("", "", value)
    is_path = name != "camera" or _is_file_of_camera(path.parent / rest)
    if name == "weights":
        from nlos_models import SHIPPED  # not for the help page

        is_path = value not in SHIPPED or (path.parent / value).exists()
    return f"{scheme}{colon}{path.parent / Path(rest).expanduser()}" if is_path else value


def _split_scheme(camera: str) -> tuple[str, str, str]:
    """Return scheme, colon and rest of a camera's name; a path alone may have colons of its own."""
    from nlos_cam.camera import SCHEMES  # not for the help page

    scheme, colon, rest = camera.partition(":")
    return (scheme, colon, rest) if scheme in SCHEMES else ("", "", camera)


def _is_file_of_camera(path: Path) -> bool:
    """Return True for a scene, a recording, or the folder of one of ROS 2."""
    from nlos_cam.camera import full_uri  # not for the help page

    return path.suffix == ".toml" or full_uri(path).startswith("bag:")


Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Also print details, such as the time of each stage."),
]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", help="Print no messages and no progress; errors stay.")
]
CameraOption = Annotated[str | None, typer.Option("--camera", help="The same as CAMERA.")]


def shared_options(name: str, command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the options of all commands, settings for options that are not given,
    and one CAMERA.
    """
    every = {
        each.name: each for each in inspect.signature(command, eval_str=True).parameters.values()
    }
    keyword = inspect.Parameter.KEYWORD_ONLY
    if takes_camera := "camera" in every:
        every["camera"] = every["camera"].replace(
            default=None, annotation=_optional(every["camera"].annotation)
        )
        every["camera_option"] = inspect.Parameter(
            "camera_option", keyword, default=None, annotation=CameraOption
        )
    every["verbose"] = inspect.Parameter("verbose", keyword, default=False, annotation=Verbose)
    every["quiet"] = inspect.Parameter("quiet", keyword, default=False, annotation=Quiet)

    @wraps(command)
    def run(**values: Any) -> None:
        _take_detail(values)
        settings = read_settings()
        used = {key: value for key, value in settings.items() if name in SETTINGS[key].commands}
        is_named = not takes_camera or _choose_camera(values, used, may_be_folder=name == "detect")
        _choose_bench(values, used)
        _fill(values, used)
        if not is_named:
            _take_default_camera(values)

        try:
            with _cache_at(settings["cache"]) if name != "config" else nullcontext():
                command(**values)
        except KeyboardInterrupt as interruption:  # typer would drop its text
            say_interrupted(*interruption.args)
            raise

    parameters = [each.replace(kind=keyword) for each in every.values()]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__dict__["__signature__"] = inspect.Signature(parameters)
    return run


def _take_detail(values: dict[str, Any]) -> None:
    """Set how much is printed, by the two options of all commands."""
    verbose = values.pop("verbose")
    quiet = values.pop("quiet")
    if verbose and quiet:
        raise typer.BadParameter("--verbose and --quiet contradict each other: give one")
    set_detail(verbose=verbose, quiet=quiet)


@contextmanager
def _cache_at(setting: Value) -> Generator[None]:
    """Set the environment variable of the cache, which child processes read too, within the
    block.
    """
    before = os.environ.get(variable("cache"))
    os.environ |= {variable("cache"): str(setting.value)} if setting.value else {}
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(variable("cache"), None)


def _optional(annotation: Any) -> Any:
    return Annotated[annotation.__origin__ | None, *annotation.__metadata__]


def _choose_camera(values: dict[str, Any], used: dict[str, Value], *, may_be_folder: bool) -> bool:
    """Enter the camera of the argument, the option or the setting; another than the setting's has
    another wall. A bench folder as the argument, beside the option, is --bench. Where it
    `may_be_folder`, a folder stands for the session in it. Return whether anything named a camera,
    or a recording in place of one.
    """
    argument = values.pop("camera")
    option = values.pop("camera_option")
    if None not in {argument, option} and "bench" in used and _is_bench(argument):
        if values["bench_folder"] is not None:
            raise typer.BadParameter(f"{argument} and --bench each name a bench folder: give one")
        values["bench_folder"] = Path(argument)
        argument = None
    if None not in {argument, option} and argument != option:
        raise typer.BadParameter(f"CAMERA is {argument!r} and --camera is {option!r}: give one")
    given = option if argument is None else argument
    if given is not None and (
        _is_another(given, used["camera"])
        or (given == "sim" and any(_is_of_a_lidar(used.get(name)) for name in ("bench", "wall")))
    ):
        _drop_bench(values, used, given)
    values["camera"] = (
        used["camera"].value if given is None and values.get("bag") is None else given
    )
    camera = values["camera"]
    if camera is not None and not (may_be_folder and Path(str(camera)).is_dir()):
        from nlos_cam.camera import full_uri

        values["camera"] = full_uri(str(camera))
    is_default = given is None and used["camera"].source == DEFAULT
    return not is_default or values.get("bag") is not None


def _drop_bench(values: Mapping[str, Any], used: dict[str, Value], given: str) -> None:
    """Drop wall and bench of the settings, which are not those of what was given; say so where no
    other is named.
    """
    is_named = any(values.get(name) is not None for name in ("wall", "bench_folder"))
    for key in ("wall", "bench"):
        if key in used and (left := used.pop(key)).value is not None and not is_named:
            say(f"note: {key} = {left.value} (from {left.source}) is not used with {given}")


def _take_default_camera(values: dict[str, Any]) -> None:
    """Enter the lidar that measured the bench: its frames are no simulated camera's. Without one,
    say that the camera is simulated.

    A bench that was measured on a simulated scene names none: it was another scene then.
    """
    folder = values.get("bench_folder") or values.get("occluder")
    of_bench = ""
    if folder is not None and not Path(folder).is_file():
        serial = _serial_of(folder)
        if serial is None:  # the command says what is wrong with it
            return
        if not _is_simulated(serial):
            values["camera"] = f"l515:{serial}"  # others may be connected
            return
        of_bench = f"; {folder} was measured on a scene that may be another"
    say(f"note: no CAMERA is given, so that sim is used, the simulated one{of_bench}")


def _serial_of(folder: str | Path) -> str | None:
    """Return the serial number of the camera that measured a bench or a wall record; None for what
    is neither.
    """
    from nlos_calibration import is_wall_record, load_wall

    try:
        if is_wall_record(str(folder)):
            return load_wall(Path(folder)).serial
        if not _is_bench(str(folder)):
            return None
        from nlos_cam.bench import load_bench_record

        return load_bench_record(Path(folder)).camera.serial
    except CalibrationError:
        return None


def _is_simulated(serial: str) -> bool:
    from nlos_cam.camera import SIMULATED_SERIAL

    return serial in {"", SIMULATED_SERIAL}


def _is_of_a_lidar(bench: Value | None) -> bool:
    """Return True for a bench or a wall record of the settings that a real lidar measured."""
    if bench is None or bench.value is None:
        return False
    serial = _serial_of(str(bench.value))
    return serial is not None and not _is_simulated(serial)


def _is_another(given: str, setting: Value) -> bool:
    """Return whether a camera is another one than that of the settings, whose wall is not its own.

    Without a camera in the settings, their wall is a real camera's; l515 is any L515.
    """
    wanted = str(setting.value)
    if given == wanted:
        return False
    if setting.source == DEFAULT:
        return given.partition(":")[0] == "sim"
    kinds = {name.partition(":")[0] for name in (given, wanted)}
    return "l515" not in {given, wanted} or len(kinds) > 1


def _is_bench(name: str) -> bool:
    """Return True for the path of a bench folder."""
    if not Path(name).is_dir():
        return False
    from nlos_cam.bench import is_bench  # not for the help page

    return is_bench(Path(name))


def names_object(argument: str) -> bool:
    """Return True for a first argument of `predict` that is its OBJECT, and no rig or bench: a mesh,
    a depth map, or a category that no file and no bench folder has the name of.
    """
    from nlos_cam.objects import object_kind  # not for the help page

    try:
        kind = object_kind(argument)
    except UnknownNameError:
        return False
    return kind != "category" or not (Path(argument).is_file() or _is_bench(argument))


def _names_rig(values: Mapping[str, Any]) -> bool:
    """Return True for a rig that was given. The only argument of `predict` may be its object."""
    rig = values.get("rig")
    is_alone = "hidden" in values and values["hidden"] is None
    return rig is not None and not (is_alone and names_object(rig))


def _is_result(given: object) -> bool:
    """Return True for what holds its own pictures or turns: a saved session, or a folder that is
    neither a bench nor a recording of ROS 2.
    """
    if not isinstance(given, str | Path) or not str(given):
        return False
    path = Path(given)
    is_folder = path.is_dir() and not (path / ROS2_RECORD).exists() and not _is_bench(str(path))
    return path.suffix == ".html" or is_folder


def _is_packaged(given: object) -> bool:
    """Return True for the recording of the package, which is of no bench that a user has."""
    return str(given).removeprefix("bag:") == SAMPLE and not Path(SAMPLE).is_file()


def _choose_bench(values: Mapping[str, Any], used: dict[str, Value]) -> None:
    """Drop the settings that contradict the bench, wall, rig, dataset or saved session that was
    given.

    A bench has its own wall and weights, so those of the settings are for commands without one.
    """
    if any(_is_result(values.get(name)) for name in ("file", "camera")):
        for name in ("bench", "wall", "weights"):
            used.pop(name, None)
    if any(_is_packaged(values.get(name)) for name in ("file", "bag", "camera")):
        _drop_bench(values, used, SAMPLE)
    if any(values.get(name) is not None for name in ("wall", "data")) or _names_rig(values):
        used.pop("bench", None)
    if values.get("bench_folder") is not None or ("bench" in used and used["bench"].value):
        used.pop("wall", None)
        used.pop("weights", None)


def _fill(values: dict[str, Any], used: Mapping[str, Value]) -> None:
    """Enter the settings of options that were not given, and print them if details are wanted."""
    for key, (value, source) in used.items():
        parameter = PARAMETERS.get(key, key)
        if key == "camera" or value is None or values.get(parameter) is not None:
            continue
        if key == "view_port" and values.get("no_view"):
            continue
        values[parameter] = value if key == "view_port" else Path(str(value))
        if Detail.verbose:
            say(f"{key} = {value} (from {source})")


def config(json: Json = False) -> None:
    """Show the settings of nlos-cam.toml and the environment, and the place that each comes
    from.
    """
    settings = read_settings()
    if not json:
        table = Table("setting", "value", "from", "stands for", box=None, pad_edge=False)
        for name, (value, source) in settings.items():
            shown = "" if value is None else escape(str(value))
            table.add_row(name, shown, escape(source), SETTINGS[name].meaning)
        show(table)
    result = {
        name: {"value": value, "source": source} for name, (value, source) in settings.items()
    }
    text = (
        f"Set them in {FILE} (here or in {typer.get_app_dir('nlos-cam')}), or as"
        f" {variable('camera')} and so on"
    )
    finish({"settings": result}, as_json=json, text=text)
