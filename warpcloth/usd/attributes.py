"""The table that maps attributes of a USD stage to fields of a scene, for reading and writing.

A cloth is a Mesh prim (or linear BasisCurves) with attributes on it or on the Xform above it; those on the cloth win. Ours are
in SI units and world space, standard ones in the units of the stage; where both are authored, ours win. For a linen cloth:

    double warpcloth:density = 0.15
    token warpcloth:terms:threads:type = "Spring"
    token warpcloth:terms:threads:pairs = "edges"
    double warpcloth:terms:threads:stiffness = 1000
    token warpcloth:terms:bending:type = "QuadraticBending"
    double warpcloth:terms:bending:stiffness = 1e-5

docs/usd.md says how rest shape, pins, frame rate, duration and gravity are found.
"""

from dataclasses import dataclass, fields

import numpy as np

from ..base.checks import did_you_mean
from ..base.texts import camel_case
from ..terms import TERMS
from .modules import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdSkel, Vt
from .values import refuse_unknown, value_of


@dataclass(frozen=True)
class Attribute:
    """One row of the table.

    Attributes:
        field: Field of `Scene`, `Pins` ("pins.…"), a term ("terms.…") or `Mesh` ("mesh.…"); in brackets, a quantity for
            several.
        name: Name of the attribute; <name> is any name of a term.
        location: Its prim: "cloth", the cloth or the Xform above it; "body", the cloth or the nearest prim above it with
            PhysicsDeformableBodyAPI; "material", the physics material bound to that; "collider", a collider or the Xform above
            it; "its material", the physics material bound to a collider; "attachment", a PhysicsAttachment; "physics scene".
        type_names: Allowed types, of any precision; the first for one value, the last for several.
        kilograms, metres: Powers of kilogramsPerUnit and metersPerUnit by which to multiply for SI units.
    """

    field: str
    name: str
    location: str
    type_names: tuple
    kilograms: int = 0
    metres: int = 0

    @property
    def types(self):
        """The allowed types."""
        return [Sdf.ValueTypeNames.Find(name) for name in self.type_names]

    @property
    def infinite(self):
        """Whether it may be infinite: terms check their values, and USD uses −inf for the earth's gravity."""
        return self.field.startswith("terms.") or self.field in _INFINITE


_INFINITE = ("(gravity magnitude)", "contact.stiffness", "(attachment stiffness)", "(shell thickness)")

ATTRIBUTES = (
    # Our own. Of several rows of one field, the first wins.
    Attribute("name", "warpcloth:name", "cloth", ("string",)),
    Attribute("density", "warpcloth:density", "cloth", ("double",)),
    Attribute("fabric", "warpcloth:fabric", "cloth", ("token",)),  # in place of a density, terms and a thickness
    Attribute("warp", "warpcloth:warp", "cloth", ("double3",)),  # vector along the warp of the fabric
    Attribute("thickness", "warpcloth:thickness", "cloth", ("double",)),
    Attribute("masses", "warpcloth:masses", "cloth", ("double[]",)),
    Attribute("positions", "warpcloth:positions", "cloth", ("double3[]",)),
    Attribute("velocities", "warpcloth:velocities", "cloth", ("double3[]",)),
    Attribute("free_axes", "warpcloth:freeAxes", "cloth", ("int3[]",)),  # 1 along axes on which a vertex moves, 0 along others
    Attribute("gravity", "warpcloth:gravity", "cloth", ("double3",)),
    Attribute("duration", "warpcloth:duration", "cloth", ("double",)),
    # Positions of the pinned vertices, those of lower index first, a time sample for each frame.
    Attribute("pins.keyframes", "warpcloth:pins:keyframes", "cloth", ("double3[]",)),
    # The axes that the pins hold, such as "xz", or one text for each pin, those of lower index first.
    Attribute("pins.axes", "warpcloth:pins:axes", "cloth", ("token", "token[]")),
    # Contact with colliders.
    Attribute("contact.distance", "warpcloth:contact:distance", "cloth", ("double",)),
    Attribute("contact.stiffness", "warpcloth:contact:stiffness", "cloth", ("double",)),
    # Self-contact.
    Attribute("self_contact.distance", "warpcloth:selfContact:distance", "cloth", ("double",)),
    Attribute("self_contact.stiffness", "warpcloth:selfContact:stiffness", "cloth", ("double",)),
    Attribute("self_contact.friction", "warpcloth:selfContact:friction", "cloth", ("double",)),
    Attribute("self_contact.held_pins", "warpcloth:selfContact:heldPins", "cloth", ("token",)),
    # The air around it; a wind that has time samples is that of keyframes, a sample for each frame.
    Attribute("air.wind", "warpcloth:air:wind", "cloth", ("double3", "double3[]")),
    Attribute("air.density", "warpcloth:air:density", "cloth", ("double",)),
    Attribute("air.normal_drag", "warpcloth:air:normalDrag", "cloth", ("double",)),
    Attribute("air.tangential_drag", "warpcloth:air:tangentialDrag", "cloth", ("double",)),
    # A selection or indices. The others are pinned too.
    Attribute("pins.vertices", "warpcloth:pins", "cloth", ("string", "int[]")),
    Attribute("(pin weights)", "primvars:pins", "cloth", ("float[]",)),
    # Loads; a value that has time samples is that of keyframes, a sample for each frame.
    Attribute("loads.type", "warpcloth:loads:<name>:type", "cloth", ("token",)),
    Attribute("loads.name", "warpcloth:loads:<name>:name", "cloth", ("string",)),  # as that of a term
    Attribute("loads.vertices", "warpcloth:loads:<name>:vertices", "cloth", ("string", "int[]")),
    Attribute("loads.force", "warpcloth:loads:<name>:force", "cloth", ("double3", "double3[]")),
    Attribute("loads.traction", "warpcloth:loads:<name>:traction", "cloth", ("double3", "double3[]")),
    Attribute("loads.pressure", "warpcloth:loads:<name>:pressure", "cloth", ("double", "double[]")),
    # The mesh in double precision. Used only if the prim's own points and curves agree, so that an artist's edit wins.
    Attribute("mesh.points", "warpcloth:points", "cloth", ("double3[]",)),  # in the prim's own space
    Attribute("mesh.edges", "warpcloth:edges", "cloth", ("int2[]",)),  # of curves, in order
    Attribute("mesh.grid_shape", "warpcloth:gridShape", "cloth", ("int2",)),
    # Parts that were joined, in order: names, numbers of vertices, and shapes of those that are grids, else (0, 0).
    Attribute("mesh.parts", "warpcloth:parts", "cloth", ("token[]",)),
    Attribute("mesh.part_sizes", "warpcloth:partSizes", "cloth", ("int[]",)),
    Attribute("mesh.part_grid_shapes", "warpcloth:partGridShapes", "cloth", ("int2[]",)),
    # Colliders: whether it is one, or how a mesh is approximated; points in double precision, used only if they agree.
    Attribute("(collides)", "warpcloth:collider", "collider", ("bool", "token")),
    Attribute("colliders.name", "warpcloth:name", "collider", ("string",)),
    Attribute("colliders.friction", "warpcloth:friction", "collider", ("double",)),
    Attribute("colliders.points", "warpcloth:points", "collider", ("double3[]",)),
    Attribute("(collides)", "physics:collisionEnabled", "collider", ("bool",)),
    Attribute("(approximation)", "physics:approximation", "collider", ("token",)),
    Attribute("colliders.friction", "physics:dynamicFriction", "its material", ("float",)),
    Attribute("(static friction)", "physics:staticFriction", "its material", ("float",)),
    # Standard: UsdPhysics, the AOUSD proposal for deformable bodies, and Newton; see `deformables`.
    Attribute("(masses)", "physics:masses", "cloth", ("float[]",), kilograms=1),
    Attribute("(masses of)", "physics:masses:elementType", "cloth", ("token",)),
    Attribute("(thicknesses)", "physics:thicknesses", "cloth", ("float[]",), metres=1),
    Attribute("(mass model)", "newton:massModel", "cloth", ("token",)),
    Attribute("(shell thickness)", "newton:shellThickness", "cloth", ("float",), metres=1),  # if the mass model is "shell"
    Attribute("(rest angles)", "physics:restBendAnglesDefault", "cloth", ("token",)),
    Attribute("(total mass)", "physics:mass", "body", ("float",), kilograms=1),  # spread evenly
    Attribute("(mass per volume)", "physics:density", "body", ("float",), kilograms=1, metres=-3),
    Attribute("(mass per volume)", "physics:density", "material", ("float",), kilograms=1, metres=-3),
    Attribute("(thickness)", "physics:surfaceThickness", "material", ("float",), metres=1),  # 1 mm where not given
    Attribute("(stretch stiffness)", "physics:surfaceStretchStiffness", "material", ("float",), kilograms=1),
    Attribute("(shear stiffness)", "physics:surfaceShearStiffness", "material", ("float",), kilograms=1),
    Attribute("(bend stiffness)", "physics:surfaceBendStiffness", "material", ("float",), kilograms=1, metres=2),
    Attribute("(Young's modulus)", "physics:youngsModulus", "material", ("float",), kilograms=1, metres=-1),
    Attribute("(Poisson's ratio)", "physics:poissonsRatio", "material", ("float",)),
    Attribute("(held points)", "physics:indices0", "attachment", ("int[]",)),
    Attribute("(kind of points)", "physics:type0", "attachment", ("token",)),
    Attribute("(kind of anchors)", "physics:type1", "attachment", ("token",)),
    Attribute("(anchors)", "physics:coords1", "attachment", ("point3f[]",)),
    Attribute("(attachment stiffness)", "physics:stiffness", "attachment", ("float",), kilograms=1),
    Attribute("(attachment damping)", "physics:damping", "attachment", ("float",), kilograms=1),
    Attribute("(attached)", "physics:attachmentEnabled", "attachment", ("bool",)),
    Attribute("(gravity direction)", "physics:gravityDirection", "physics scene", ("vector3f",)),
    Attribute("(gravity magnitude)", "physics:gravityMagnitude", "physics scene", ("float",), metres=1),
    Attribute("(gravity acts)", "newton:gravityEnabled", "physics scene", ("bool",)),
)

# Namespace of the attributes of terms.
TERMS_NAMESPACE = "warpcloth:terms"
LOADS_NAMESPACE = "warpcloth:loads"

_OF_TEXT = {"": (), "word": ("token", "token[]"), "selection": ("string", "token[]")}
_OF_NUMBERS = {(): ("double", "double[]")} | {(n,): (f"double{n}", f"double{n}[]") for n in (2, 3, 4)}
_OF_INDICES = {1: "int[]", 2: "int2[]", 3: "int3[]", 4: "int4[]"}


def attributes():
    """Returns all rows of the table: one for each field of the registered energies, and those above."""
    rows = {
        "type": ("token",),
        "part": ("token",),
        "name": ("string",),  # only if <name> is not the name of the term; empty if the term has none
    }
    for energy in TERMS.values():
        for field in fields(energy):
            quantity, indices = field.metadata.get("quantity"), field.metadata.get("indices")
            types = ()  # if USD has no type for the shape of its values
            if quantity and quantity.shape in _OF_NUMBERS:
                types = _OF_NUMBERS[quantity.shape]
            elif indices and indices.each in _OF_INDICES:
                types = (*_OF_TEXT[indices.text], _OF_INDICES[indices.each])
            if not types:
                continue
            rows[field.name] = tuple(dict.fromkeys((*rows.get(field.name, ()), *types)))
    of_terms = [
        Attribute(f"terms.{name}", f"{TERMS_NAMESPACE}:<name>:{camel_case(name)}", "cloth", types)
        for name, types in rows.items()
    ]
    return *of_terms, *ATTRIBUTES


class Values:
    """The attributes of a cloth, a collider or an attachment by field, in SI units.

    Raises:
        ValueError: A name in our namespace is not in the table.
    """

    def __init__(self, stage, prim, kind="cloth"):
        self.kilograms = UsdPhysics.GetStageKilogramsPerUnit(stage)
        self.metres = UsdGeom.GetStageMetersPerUnit(stage)
        if kind == "attachment":
            self.locations = {"attachment": [prim]}
            return
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        if kind == "cloth":
            self.locations = {"cloth": holders(prim), "body": [_body(prim)], "material": [material]}
        else:
            self.locations = {"collider": holders(prim), "its material": [material]}
        names = own_names(prim)
        # In the order of the prim's properties, by default that of their names.
        self.terms, self.loads = (
            list(dict.fromkeys(name.split(":")[2] for name in names if name.startswith(f"{namespace}:")))
            for namespace in (TERMS_NAMESPACE, LOADS_NAMESPACE)
        )
        rows = [row for row in attributes() if row.location in self.locations]
        known = {row.name.replace("<name>", key) for row in rows for key in (*self.terms, *self.loads, "")}
        unknown = sorted(set(names) - known)
        if unknown:
            for key in self.terms:  # an unknown type of a term may be the reason
                kind_of(self, key)
            allowed = ", ".join(row.name for row in rows if row.name.startswith("warpcloth:"))
            raise ValueError(
                f"{unknown[0]} is no attribute of a {kind}, must be one of {allowed}{did_you_mean(unknown[0], known)}"
            )

    def authored(self, field, key=None):
        """Returns the authored attributes of a field, (row, Usd.Attribute) in order of precedence; refuses wrong types."""
        for row in attributes():
            for prim in self.locations.get(row.location, ()) if row.field == field else ():
                attribute = prim and prim.GetAttribute(row.name.replace("<name>", str(key)))
                if attribute and attribute.HasAuthoredValue():
                    if _kind(attribute.GetTypeName()) not in [_kind(type_name) for type_name in row.types]:
                        types = " or ".join(str(type_name) for type_name in row.types)
                        raise ValueError(f"{attribute.GetName()} has type {attribute.GetTypeName()}, must be {types}")
                    yield row, attribute

    def get(self, field, key=None):
        """Returns the value of a field as a number, text, tuple of texts or array; None if it is not authored."""
        for row, attribute in self.authored(field, key):
            value = value_of(attribute, Usd.TimeCode.EarliestTime())
            if value is None:
                raise ValueError(f"{attribute.GetName()} is blocked at its first time sample, must have a value")
            if row.name.startswith("warpcloth:") and attribute.ValueMightBeTimeVarying():
                raise ValueError(f"{attribute.GetName()} changes over time, must have one value")
            if isinstance(value, str):
                return value
            if isinstance(value, (Vt.TokenArray, Vt.StringArray)):
                return tuple(value)
            value = np.array(value)[()]
            if row.location == "material" and value == -np.inf:  # in the proposal, the default of a simulator
                continue
            refuse_unknown(attribute.GetName(), np.asarray(value), infinite=row.infinite)
            signed = row.field == "(Poisson's ratio)"
            if row.location in ("body", "material", "its material") and value < 0 and not signed:
                raise ValueError(f"{attribute.GetName()} is {value}, must be 0 or more")
            # In UsdPhysics and the proposal, 0 stands for a mass, density or stiffness that is not given.
            if row.location not in ("body", "material") or value != 0 or signed:
                scale = self.kilograms**row.kilograms * self.metres**row.metres
                return value if scale == 1 else value * scale
        return None


def kind_of(values, key, catalogue=TERMS, group="terms"):
    """Returns the name of a term's energy, or of a load's kind; refuses unknown ones."""
    kind = values.get(f"{group}.type", key)
    if kind not in catalogue:
        given = "not given" if kind is None else repr(kind)
        more = ", or of an energy from elsewhere that is imported (--import)" if group == "terms" else ""
        raise ValueError(f"warpcloth:{group}:{key}:type is {given}, must be one of {', '.join(catalogue)}{more}")
    return kind


def _kind(type_name):
    default = type_name.scalarType.defaultValue
    return default is None, isinstance(default, str), type_name.isArray, np.shape(default)


def _rank(type_name):
    default = type_name.scalarType.defaultValue
    return -1 if isinstance(default, str) else np.ndim(default) + type_name.isArray


def has_api(prim, name):
    """Returns whether an API schema is applied, by name: the deformable ones need not be registered."""
    return name in prim.GetPrimTypeInfo().GetAppliedAPISchemas()


def holders(prim):
    """Returns the prims that may have the attributes of a shape: itself, and an Xform or SkelRoot above it."""
    parent = prim.GetParent()
    return [prim, parent] if parent.IsA(UsdGeom.Xform) or parent.IsA(UsdSkel.Root) else [prim]


def own_names(prim):
    """Returns the names of our attributes that a shape has."""
    return [each.GetName() for holder in holders(prim) for each in holder.GetAuthoredPropertiesInNamespace("warpcloth")]


def _body(cloth):
    prim = cloth
    while prim and not has_api(prim, "PhysicsDeformableBodyAPI"):
        prim = prim.GetParent()
    return prim or cloth


def author(cloth, field, value, key=None, time=None):
    """Writes a value with the name and the type of the table."""
    row = next((row for row in attributes() if row.field == field), None)
    if row is None:
        raise ValueError(
            f"{field} has no attribute; its field must have the metadata of a quantity or of indices, of a shape in USD"
        )
    if isinstance(value, str) or np.ndim(value) == 0:
        type_name = row.types[0]
        value = value if isinstance(value, str) else float(value)
    elif isinstance(value[0], str):
        type_name, value = Sdf.ValueTypeNames.TokenArray, Vt.TokenArray([str(text) for text in value])
    else:
        type_name = next((each for each in row.types if _rank(each) == np.ndim(value)), row.types[-1])
        whole = np.asarray(type_name.scalarType.defaultValue).dtype.kind == "i"
        shape = np.shape(type_name.scalarType.defaultValue)
        array = np.ascontiguousarray(value, np.int32 if whole else np.float64)
        sequence = type(type_name.defaultValue)
        value = sequence.FromNumpy(array.reshape(-1, *shape)) if type_name.isArray else sequence(*array.tolist())
    attribute = cloth.CreateAttribute(row.name.replace("<name>", str(key)), type_name)
    attribute.Set(value, Usd.TimeCode.Default() if time is None else time)
