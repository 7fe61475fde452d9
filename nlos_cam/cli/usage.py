"""Wording of usage errors: the reason in one line, and the help page to try."""

from typing import Any

import typer

from nlos_cam.errors import did_you_mean

NUMBERS = {int: "a whole number", float: "a number"}


def usage_reason(error: typer.TyperException) -> str:
    """Return the reason of a usage error in one line: the option, the value and the remedy."""
    parameter: Any = getattr(error, "param", None)
    if option := getattr(error, "option_name", None):
        return _option_reason(option, getattr(error, "possibilities", ()))
    if parameter and hasattr(error, "param_type"):
        return f"{_name(parameter)} is missing: {_lower(parameter.help or 'give it')}".rstrip(".")
    if parameter and (invalid := getattr(error.__cause__, "errors", None)):
        return _value_reason(parameter, invalid()[0]["input"])
    return _message_reason(error)


def usage_lines(error: typer.TyperException) -> tuple[str, str]:
    """Return the usage line of the command in error, and the line that names its help; empty
    without a command.
    """
    context: Any = getattr(error, "ctx", None)
    if context is None:
        return "", ""
    return " ".join(context.get_usage().split()), f"Try `{context.command_path} --help`"


def _option_reason(option: str, possible: Any) -> str:
    if possible == ():  # the error of an option without its value has no such field
        return f"{option} needs a value"
    near = f". Did you mean {' or '.join(possible)}?" if possible else ""
    return f"no option {option}{near}"


def _message_reason(error: typer.TyperException) -> str:
    context: Any = getattr(error, "ctx", None)
    message = str(getattr(error, "message", "") or error.format_message())
    if "unexpected extra argument" in message:
        extra = message.rpartition("(")[2].rstrip(").")
        return f"unexpected argument {extra!r}"
    if message.startswith(("No such command", "Missing command")) and context and context.parent:
        ended = message if message.endswith("?") else message.rstrip(".") + "."
        return f"{ended} Choose from {', '.join(context.command.commands)}"
    return message


def _value_reason(parameter: Any, value: Any) -> str:
    """Return the values that a parameter takes, and the one that it got instead."""
    name = _name(parameter)
    kind = parameter.type_descriptor
    if kind.choices is None:
        wanted = NUMBERS.get(kind.annotation, "a valid value")
        return f"{name} must be {wanted}{_bounds(parameter)} (got {value!r})"
    names = [str(choice) for choice in kind.choices]
    near = did_you_mean(str(value), names)
    reason = f"{name} must be {_listed(names)} (got {value!r})"
    return f"{reason}.{near}" if near else reason


def _bounds(parameter: Any) -> str:
    low = getattr(parameter, "min", None)
    high = getattr(parameter, "max", None)
    if high is None:
        return "" if low is None else f" of at least {low:g}"
    return f" to {high:g}" if low is None else f" from {low:g} to {high:g}"


def _name(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return str(parameter.metavar or parameter.name).upper()
    return max(parameter.opts, key=len)


def _listed(names: list[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:] if text[1:2].islower() else text
