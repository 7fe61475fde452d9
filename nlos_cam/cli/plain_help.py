"""Help pages with real placeholders (FILE, SECONDS) and ranges in words, for a typer command
tree.
"""

from collections.abc import Iterable
from typing import Any

PLACEHOLDERS = {
    "seconds": "SECONDS",
    "view_port": "PORT",
    "view_host": "HOST",
    "camera": "CAMERA",
    "seed": "SEED",
    "rig": "RIG",
    "rig_name": "RIG",
    "ray": "ADDRESS",
    "out": "PATH",
    "minutes": "MINUTES",
    "max_seconds": "SECONDS",
}
"""Placeholder of an option by its parameter; others follow from the suffix or the type."""
SUFFIXES = {
    "_ms": "MS",
    "_s": "SECONDS",
    "_m": "METRES",
    "_mm": "MM",
    "_deg": "DEGREES",
    "_ns": "NS",
}
TYPES = {"path": "PATH", "int": "N", "float": "X", "str": "TEXT", "range": "N"}
HUGE = 1e6
TINY = 0.05
"""Bounds beyond these only guard against nonsense: they are left out of the help."""


def plain_help(command: Any) -> None:
    """Set placeholders and range texts of a command's options, and of its subcommands'."""
    for parameter in command.params:
        _describe(parameter)
    help_option = command.get_help_option

    def flag_only(context: Any) -> Any:
        option = help_option(context)
        option.metavar = ""
        return option

    command.get_help_option = flag_only
    children: Iterable[Any] = getattr(command, "commands", {}).values()
    for child in children:
        plain_help(child)


def _describe(parameter: Any) -> None:
    low = getattr(parameter, "min", None)
    high = getattr(parameter, "max", None)
    if text := range_text(low, high):
        sentence = parameter.help or ""
        stem = sentence if sentence.endswith("...") else sentence.removesuffix(".")
        parameter.help = f"{stem} ({text})."
    # typer has no public way to leave "[x>=0.1]" out
    parameter._get_number_range_help_str = lambda: None  # noqa: SLF001
    if parameter.param_type_name == "option" and parameter.metavar is None:
        parameter.metavar = "" if getattr(parameter, "is_flag", False) else placeholder(parameter)


def placeholder(parameter: Any) -> str | None:
    """Return an option's placeholder; None where its type names the choices."""
    if parameter.type_descriptor.is_choice:
        return None
    name = str(parameter.name)
    if name in PLACEHOLDERS:
        return PLACEHOLDERS[name]
    for end, unit in SUFFIXES.items():
        if name.endswith(end):
            return unit
    descriptor = parameter.type_descriptor
    kind = str(descriptor.path_type if descriptor.is_path else parameter.bare_type())
    kind = kind.removeprefix("list[").removesuffix("]").lower()  # may be given several times
    return TYPES.get(kind.rsplit(" ", maxsplit=1)[-1], kind.upper())


def range_text(low: float | None, high: float | None) -> str:
    """Return a range in words, "1 to 65535" or "at least 0.1"; empty where only nonsense is
    excluded.
    """
    shows_low = low is not None and not 0 < low < TINY
    shows_high = high is not None and high < HUGE
    if shows_low and shows_high:
        return f"{low:g} to {high:g}"
    if shows_high:
        return f"at most {high:g}"
    return f"at least {low:g}" if shows_low and low else ""
