"""Camera models by name. Adding a model is one file and one line here."""

from __future__ import annotations

from rigkit.cameras.base import Camera
from rigkit.cameras.brown import Brown
from rigkit.cameras.double_sphere import DoubleSphere
from rigkit.cameras.eucm import EUCM
from rigkit.cameras.kannala_brandt import KannalaBrandt
from rigkit.cameras.pinhole import Pinhole
from rigkit.cameras.scaramuzza import Scaramuzza
from rigkit.cameras.ucm import UCM
from rigkit.core.errors import InputError

MODELS: dict[str, type[Camera]] = {
    cls.model: cls for cls in (Pinhole, Brown, KannalaBrandt, Scaramuzza, UCM, EUCM, DoubleSphere)
}


def camera_model(name: str) -> type[Camera]:
    """Return the camera class called `name`; raises InputError that lists the known ones."""
    if name not in MODELS:
        raise InputError(f"camera model '{name[:40]}' is unknown; known: {', '.join(sorted(MODELS))}")
    return MODELS[name]


def check_order(name: str, order: int) -> None:
    """Raise InputError where the model called `name` (or "auto") has no size `order`."""
    sizes = {n: cls.orders for n, cls in MODELS.items() if cls.orders}
    known = ", ".join(f"{n} ({', '.join(map(str, orders))})" for n, orders in sizes.items())
    if name == "auto":
        raise InputError(
            f'degree {order} with model = "auto", which chooses by itself; name a model that has one: {known}'
        )
    if not camera_model(name).orders:
        raise InputError(
            f"degree {order} for {name}, which has one size only; remove it. Models that have one: {known}"
        )
    if order not in sizes[name]:
        raise InputError(f"{name} has no degree {order}; choose {', '.join(map(str, sizes[name]))}, or leave it out")
