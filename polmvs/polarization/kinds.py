"""Names of the angle models and of the kinds of light; quick to import, for the options."""

from __future__ import annotations

from enum import StrEnum


class AngleModel(StrEnum):
    """Relation between the measured angle and the surface normal, with the additions of polmvs.

    The textbook models are OPA and PPA as published: each row has its formula and the weight of
    its noise. In the others, polmvs gives rows less weight where their formula is inexact
    (``NormalOptions.tilt_aware_weights``).
    """

    OPA = "opa"
    PPA = "ppa"
    TILTED = "tilted"
    TEXTBOOK_OPA = "textbook-opa"
    TEXTBOOK_PPA = "textbook-ppa"

    @property
    def is_textbook(self) -> bool:
        """Whether the model is as published."""
        return self in (AngleModel.TEXTBOOK_OPA, AngleModel.TEXTBOOK_PPA)

    @property
    def formula(self) -> AngleModel:
        """OPA, PPA or tilted: the relation without the additions."""
        return AngleModel(self.value.removeprefix("textbook-"))

    @property
    def label(self) -> str:
        """Its name in tables and figures."""
        name = self.formula.value if self is AngleModel.TILTED else self.formula.value.upper()
        return f"textbook {name}" if self.is_textbook else f"polmvs {name}"


class Light(StrEnum):
    """Reflection that dominates the polarization of the part."""

    SPECULAR = "specular"
    DIFFUSE = "diffuse"


# In the order of a table's columns: first what the paper compares, then what polmvs makes of it.
COMPARED_MODELS = (
    AngleModel.TEXTBOOK_OPA,
    AngleModel.TEXTBOOK_PPA,
    AngleModel.OPA,
    AngleModel.PPA,
    AngleModel.TILTED,
)
FORMULAS = (AngleModel.OPA, AngleModel.PPA, AngleModel.TILTED)  # the relations, each once
