"""Hands that move the object: those of the simulated camera; a person's are in the command."""

from typing import Protocol, runtime_checkable


class Hands(Protocol):
    """Mover of the hidden object."""

    def place(self, turn: int, *, object_in: bool) -> None:
        """Move the object in or out for a turn (counted from 0), and return once all is at rest."""
        ...


@runtime_checkable
class MovableWorld(Protocol):
    """Camera whose hidden object a program can take away: the simulated one."""

    def place_object(self, *, present: bool) -> None:
        """Put the hidden object in, or take it away, from the next frame computed on."""
        ...


class SimulatedHands:
    """Hands in a simulated world; with `control` they move nothing."""

    def __init__(self, world: MovableWorld, *, control: bool = False) -> None:
        self._world = world
        self._control = control

    def place(self, turn: int, *, object_in: bool) -> None:
        del turn
        self._world.place_object(present=object_in and not self._control)
