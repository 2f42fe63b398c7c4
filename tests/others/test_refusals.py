"""Scenes that other simulators cannot express are refused, which does not need them."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.others import BENDING, MESH, SPRINGS, declared
from warpcloth.others import newton_model, pbd_model, uipc_model

START = MESH.points[[0, 3]]
FLOOR, RUG = wc.Plane(position=(0.0, -5.0, 0.0)), wc.Plane(position=(0, -6, 0), friction=0.1, name="rug")
BALL = wc.Sphere(radius=0.1, position=[(0.0, -3.0, 0.0), (0.0, -2.0, 0.0)], name="ball")
RUBBER = wc.NeoHookeanMembrane(stiffness=1.0)
FAR = {"contact": wc.Contact(distance=2e-3, stiffness=3e3), "self_contact": wc.SelfContact(distance=5e-3)}
REFUSE = {
    "libuipc": uipc_model.refuse_inexpressible,
    "pypbd": lambda scene: pbd_model.refuse_inexpressible(scene, "xpbd"),
    "vbd": lambda scene: newton_model.refuse_inexpressible(scene, "vbd"),
    "xpbd": lambda scene: newton_model.refuse_inexpressible(scene, "xpbd"),
    "style3d": lambda scene: newton_model.refuse_inexpressible(scene, "style3d"),
    "mpm": lambda scene: newton_model.refuse_inexpressible(scene, "mpm"),
}
REFUSED = [
    *(
        (each, *row)
        for each in ("libuipc", "pypbd", "vbd")
        for row in (
            ({"pins": wc.Pins([0, 3], axes="y")}, "along some axes"),
            ({"pins": wc.Pins([0, 3], keyframes=[START, START + 0.1])}, "keyframes"),
            ({"loads": wc.Pressure(vertices=np.arange(16), pressure=1.0)}, "loads"),
            ({"air": wc.Air()}, "air"),
        )
    ),
    ("libuipc", {"colliders": [BALL]}, "moving colliders in this comparison, as ball is"),
    ("libuipc", {"colliders": [FLOOR], "contact": wc.Contact(stiffness=np.inf)}, "infinite stiffness of contact"),
    ("libuipc", {"colliders": [FLOOR], **FAR}, "more than twice"),
    ("libuipc", {"terms": [wc.CorotatedMembrane(stiffness=1.0)]}, "does not take CorotatedMembrane"),
    ("libuipc", {"terms": [replace(SPRINGS, damping=1.0)]}, "damping with warpcloth's law, as that of Spring"),
    ("libuipc", {"terms": [replace(SPRINGS, stiffness=np.inf)]}, "infinite stiffness, as that of Spring"),
    ("pypbd", {"gravity": (0.0, 0.0, 0.0)}, "gravity that cannot be switched off"),
    ("pypbd", {"self_contact": wc.SelfContact()}, "self-contact"),
    ("pypbd", {"colliders": [FLOOR]}, "colliders"),
    ("pypbd", {"terms": [RUBBER]}, "does not take NeoHookeanMembrane"),
    ("pypbd", {"terms": [replace(SPRINGS, damping=1.0)]}, "damping, as that of Spring"),
    ("pypbd", {"terms": [replace(BENDING, stiffness=np.inf)]}, "infinite stiffness of QuadraticBending"),
    ("xpbd", {"self_contact": wc.SelfContact()}, "self-contact"),
    ("vbd", {"colliders": [BALL]}, "moving colliders.*ball"),
    ("vbd", {"colliders": [FLOOR, RUG]}, "friction.*rug"),
    ("vbd", {"terms": [wc.StVKMembrane(stiffness=1.0)]}, "does not take StVKMembrane"),
    ("xpbd", {"terms": [RUBBER]}, "does not take NeoHookeanMembrane"),
    ("vbd", {"terms": [wc.Spring(stiffness=np.inf)]}, "infinite stiffness.*Spring"),
    ("xpbd", {"terms": [SPRINGS, wc.QuadraticBending(stiffness=1.0, damping=1.0)]}, "damping.*QuadraticBending"),
    ("style3d", {"terms": [wc.Spring(stiffness=1.0, damping=1.0)]}, "damping.*Spring"),
    ("style3d", {"terms": [wc.Spring(stiffness=1.0, rest_lengths=0.1)]}, "rest lengths.*Spring"),
    ("style3d", {"terms": [wc.QuadraticBending(stiffness=1.0)]}, "springs or membranes"),
    ("mpm", {}, "method is 'mpm'"),
]


@pytest.mark.parametrize(("engine", "fields", "words"), REFUSED, ids=[f"{engine}-{words}" for engine, _, words in REFUSED])
def test_inexpressible_scenes_are_refused(engine, fields, words):
    with pytest.raises(ValueError, match=words):
        REFUSE[engine](declared(**({"terms": [SPRINGS]} | fields)))
