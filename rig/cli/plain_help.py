"""Commands and groups whose help names no types of the program."""

from typing import Any

from typer.core import TyperArgument, TyperCommand, TyperGroup


def _without_types(parameters: list[Any]) -> list[Any]:
    """Parameters that show what they are called and no type."""
    for parameter in parameters:
        if isinstance(parameter, TyperArgument):
            parameter.display_type_rich = _no_type
        elif parameter.metavar is None and parameter.is_flag:
            parameter.metavar = ""
    return parameters


def _no_type(ctx: object) -> str:  # noqa: ARG001 - Typer hands it over
    return ""


class PlainCommand(TyperCommand):
    """A command."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Its parameters, as its help shows them."""
        return _without_types(super().get_params(ctx))


class PlainGroup(TyperGroup):
    """A group of commands."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Its parameters, as its help shows them."""
        return _without_types(super().get_params(ctx))
