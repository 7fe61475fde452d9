"""The demonstration of colour: its recipes, with numbers of one's own."""

from collections.abc import Callable
from types import ModuleType

import pytest

Tool = Callable[[str], ModuleType]


def test_a_recipe_keeps_what_is_not_changed_and_never_has_a_batch_larger_than_its_objects(tool: Tool) -> None:
    recipe_named = tool("colour_demo").recipe_named
    whole = recipe_named("compressor")
    assert recipe_named("compressor", objects=None, epochs=None) == whole
    small = recipe_named("compressor", objects=10, epochs=2)
    assert (small.objects, small.epochs, small.batch, small.seed) == (10, 2, 10, whole.seed)


def test_a_number_that_is_none_is_refused(tool: Tool) -> None:
    with pytest.raises(ValueError, match="epochs"):
        tool("colour_demo").recipe_named("vae", epochs=0)
