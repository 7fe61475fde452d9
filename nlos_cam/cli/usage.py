"""Wording of usage errors: the reason in our own words, and the help page to try; typer's speak of
its internals.
"""

from typing import Any

import typer

from nlos_cam.errors import did_you_mean

NUMBERS = {int: "a whole number", float: "a number"}


def usage_reason(error: typer.TyperException) -> str:
    """Return the reason of a usage error in one line: the option, the value and the remedy."""
    parameter: Any = getattr(error, "param", None)
    if option := getattr(error, "option_name", None):
        possible = getattr(error, "possibilities", ())
        near = f". Did you mean {' or '.join(possible)}?" if possible else ""
        return f"{option} needs a value" if possible == () else f"no option {option}{near}"
    if parameter and hasattr(error, "param_type"):
        return f"{_name(parameter)} is missing: {_lower(parameter.help or 'give it')}".rstrip(".")
    if parameter and (cause := getattr(error.__cause__, "errors", None)):
        return _value_reason(parameter, cause()[0]["input"])
    return _message_reason(error)


def _message_reason(error: typer.TyperException) -> str:
    context: Any = getattr(error, "ctx", None)
    message = str(getattr(error, "message", "") or error.format_message())
    if extra := message.partition("unexpected extra argument")[2].rpartition("(")[2]:
        return f"unexpected argument {extra.rstrip(').')!r}"
    names = list(getattr(getattr(context, "command", None), "commands", {}))
    if message.startswith(("No such command", "Missing command")) and context and context.parent:
        return (
            f"{message if message.endswith('?') else message.rstrip('.') + '.'} Choose from"
            f" {', '.join(names)}"
        )
    return message


def usage_lines(error: typer.TyperException) -> tuple[str, str]:
    """Return the usage line of the command in error, and the line that names its help; empty
    without a command.
    """
    context: Any = getattr(error, "ctx", None)
    if context is None:
        return "", ""
    return " ".join(context.get_usage().split()), f"Try `{context.command_path} --help`"


def _listed(names: list[str]) -> str:
    return " or ".join([", ".join(names[:-1]), *names[-1:]] if names[1:] else names)


def _name(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return str(parameter.metavar or parameter.name).upper()
    return max(parameter.opts, key=len)


def _value_reason(parameter: Any, value: Any) -> str:
    """Return what a parameter takes, and the value that it got instead."""
    kind = parameter.type_descriptor
    name = _name(parameter)
    if kind.choices is not None:
        names = [str(choice) for choice in kind.choices]
        return f"{name} must be {_listed(names)} (got {value!r}).{did_you_mean(str(value), names)}".rstrip(
            "."
        )
    low = getattr(parameter, "min", None)
    high = getattr(parameter, "max", None)
    bounds = [
        f"{word} {bound:g}" for word, bound in (("from", low), ("to", high)) if bound is not None
    ]
    if high is None and low is not None:
        bounds = [f"of at least {low:g}"]
    return " ".join(
        [
            name,
            "must be",
            NUMBERS.get(kind.annotation, "a valid value"),
            *bounds,
            f"(got {value!r})",
        ]
    )


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:] if text[1:2].islower() else text
