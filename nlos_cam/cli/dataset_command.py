"""The command that made a dataset, as its shards tell it."""

import shlex

import typer


def command_of(context: typer.Context, name: str) -> str:
    """The command as it could be given again: its arguments, and every option but --json with its value."""
    words = ["nlos-cam", "dataset", name]
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if value is None or value is False or parameter.name == "json":
            continue
        option = [] if parameter.param_type_name == "argument" else [parameter.opts[0]]
        words += option if value is True else [*option, str(value)]
    return shlex.join(words)
