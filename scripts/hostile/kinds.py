"""All kinds of cases by name, and how often each is drawn."""

from collections.abc import Callable

from hostile import clouds, faults, headers, masks, names, numbers, pictures, places, records, settings, workspaces
from hostile.cases import Case, Stage

KINDS: dict[str, Callable[[Stage], Case]] = {
    "names": names.make,
    "places": places.make,
    "headers": headers.make,
    "records": records.make,
    "clouds": clouds.make,
    "pictures": pictures.make,
    "masks": masks.make,
    "numbers": numbers.make,
    "settings": settings.make,
    "damage": workspaces.make_damaged,
    "users": workspaces.make_shared,
    "faults": faults.make,
}
# Faults and places have the most ways to go wrong.
ORDER = (*KINDS, "faults", "places", "faults")


def kind_of(number: int) -> str:
    """Kind of a case."""
    return ORDER[number % len(ORDER)]
