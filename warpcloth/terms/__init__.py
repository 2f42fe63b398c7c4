"""The energies that a scene declares, one record each."""

from .terms import (
    TERMS,
    Attachment,
    CorotatedMembrane,
    Declared,
    DihedralBending,
    Elements,
    NeoHookeanMembrane,
    QuadraticBending,
    RigidCluster,
    Spring,
    SpringLimit,
    StrainLimit,
    StVKMembrane,
)

__all__ = [
    "TERMS",
    "Attachment",
    "CorotatedMembrane",
    "Declared",
    "DihedralBending",
    "Elements",
    "NeoHookeanMembrane",
    "QuadraticBending",
    "RigidCluster",
    "Spring",
    "SpringLimit",
    "StVKMembrane",
    "StrainLimit",
]
