"""The table of the 18 kinds of things of SI 1: each a generator with its settings.

A person names each from its picture. A generator builds the thing as it stands (y up), in units of its own size, with
the side worth seeing towards the wall (z negative).
"""

from nlos_cam.objects.buildings import birdhouse, tower
from nlos_cam.objects.furniture import computer, cupboard, oven, soundbox, table
from nlos_cam.objects.household import baskets, bell, bowl, cup, hat, lamp
from nlos_cam.objects.settings import Category
from nlos_cam.objects.vehicles import airplane, boat, car, motorcycle, rocket

_VEHICLES = airplane, boat, car, motorcycle, rocket
_HOUSEHOLD = baskets, bell, bowl, cup, hat, lamp
_FURNITURE = computer, cupboard, oven, soundbox, table
_BUILDINGS = birdhouse, tower

CATEGORIES: dict[str, Category] = {
    kind.name: kind for kind in sorted((*_VEHICLES, *_HOUSEHOLD, *_FURNITURE, *_BUILDINGS), key=lambda kind: kind.name)
}
"""By name, in the order of the alphabet: a seed picks the same thing everywhere."""
