"""The models that a HallThruster.jl input names: field, transport, wall and conductivity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ep2sindy.thruster.hallthruster_nodes import Node
from ep2sindy.thruster.magnetic_field import MagneticFieldTable, read_magnetic_field
from ep2sindy.thruster.transport import (
    AnomalousTransport,
    GaussianTransport,
    MultiLogTransport,
    Transport,
)
from ep2sindy.thruster.walls import ExponentialWall, SheathWall, Wall, wall_material

MATERIALS = {
    "BNSiO2": "BN-SiO2",
    "BoronNitride": "BN",
    "Alumina": "alumina",
    "SiliconCarbide": "SiC",
    "SiliconDioxide": "SiO2",
}


def field_of(node: Node, length: float, folder: Path, scale: float) -> MagneticFieldTable:
    """The points in the file itself, or those of the file that it names, in m and T."""
    name, z, B = node.take("file", ""), node.take("z", []), node.take("B", [])
    node.end()
    if len(z) and len(B):
        return MagneticFieldTable(
            tuple((np.array(z) - length).tolist()), tuple((scale * np.array(B)).tolist())
        )
    places = (folder / name, Path.cwd() / name)
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise ValueError(
            f"{node.place}.file must be there: {name!r} is neither in {folder.absolute()} nor in "
            f"{Path.cwd()}"
        )
    return read_magnetic_field(found, exit_m=length, z_unit="m", B_unit="T", scale=scale)


def transport_of(node: Node, length: float, transition: float) -> Transport:
    """Bohm-like models; positions are counted from the anode there, from the exit here."""
    kind = node.take("type")
    if kind == "TwoZoneBohm":
        c = node.take("coeffs", None) or (
            node.number("c1", 1 / 160),
            node.number("c2", 1 / 16),
        )
        model: Transport = AnomalousTransport(float(c[0]), float(c[1]), transition)
    elif kind == "Bohm":
        c_everywhere = node.number("c")
        model = AnomalousTransport(c_everywhere, c_everywhere, 0.0)
    elif kind == "GaussianBohm":
        model = GaussianTransport(
            c_far=node.number("hall_max"),
            trough=node.number("hall_min"),
            center=node.number("center") - length,
            width=node.number("width"),
        )
    elif kind == "MultiLogBohm":
        z = np.array(node.take("zs"), dtype=float) - length
        model = MultiLogTransport(tuple(z.tolist()), tuple(map(float, node.take("cs"))))
    else:
        raise ValueError(
            f"{node.place}.type must be TwoZoneBohm, Bohm, GaussianBohm or MultiLogBohm: {kind!r} "
            "is not supported here"
        )
    node.end()
    return model


def wall_of(node: Node, *, transition: float, plume_power: float, ion_losses: bool) -> Wall:
    """Their one loss_scale acts on electrons and, with ion_wall_losses, on ions."""
    kind = node.take("type")
    if kind == "NoWallLosses":
        node.end()
        return SheathWall(electron_scale=0.0, ion_scale=0.0)
    if kind == "ConstantSheathPotential":
        if ion_losses:
            raise ValueError("config.ion_wall_losses needs a WallSheath here")
        wall: Wall = ExponentialWall(
            (node.number("inner_loss_coeff"), node.number("outer_loss_coeff")),
            sheath_V=node.number("sheath_potential", 20.0),
            transition=transition,
        )
    elif kind == "WallSheath":
        material: Any = node.take("material", "BNSiO2")
        scale = node.number("loss_scale", 1.0)
        if material not in MATERIALS:
            raise ValueError(
                f"{node.place}.material must be one of {list(MATERIALS)}: {material!r} came"
            )
        wall = wall_material(
            MATERIALS[material],
            electron_scale=scale,
            ion_scale=scale if ion_losses else 0.0,
            plume_collisions=0.0,
            plume_power=plume_power,
            transition=transition,
        )
    else:
        raise ValueError(
            f"{node.place}.type must be WallSheath, ConstantSheathPotential or NoWallLosses: "
            f"{kind!r} is not supported here"
        )
    node.end()
    return wall


def conduction_of(node: Node) -> tuple[float, float]:
    """Factor and weight of Coulomb collisions of `Thruster`, which takes the gradient of T_e.

    Mitchner & Kruger, Partially Ionized Gases (1973), p. 94: 2.4/(1 + nu_ei/(sqrt(2) nu));
    Braginskii: 4.66 for one charge; both times 1.5, since theirs multiply the gradient of 1.5 T_e.
    """
    kind = node.take("type")
    node.end()
    known = {"Mitchner": (1.5 * 2.4, 2.0**-0.5), "Braginskii": (1.5 * 4.66, 0.0)}
    if kind not in known:
        raise ValueError(f"{node.place}.type must be one of {list(known)}: {kind!r} came")
    return known[kind]
