"""The angle models, and the kinds of light, by name: light to import, as the options need them."""

from __future__ import annotations

from enum import StrEnum


class AngleModel(StrEnum):
    """Relation between the measured angle and the surface normal, and what polmvs adds to it.

    The textbook models are OPA and PPA as published: each row says what its formula says, with the
    weight of its noise. To the others polmvs adds what formula and camera leave open: rows count
    less where their formula errs (``NormalOptions.tilt_aware_weights``).
    """

    OPA = "opa"
    PPA = "ppa"
    TILTED = "tilted"
    TEXTBOOK_OPA = "textbook-opa"
    TEXTBOOK_PPA = "textbook-ppa"

    @property
    def is_textbook(self) -> bool:
        """Whether nothing is added to the published model."""
        return self in (AngleModel.TEXTBOOK_OPA, AngleModel.TEXTBOOK_PPA)

    @property
    def formula(self) -> AngleModel:
        """OPA, PPA or tilted: the relation alone."""
        return AngleModel(self.value.removeprefix("textbook-"))

    @property
    def label(self) -> str:
        """Its name in tables and figures."""
        name = self.formula.value if self is AngleModel.TILTED else self.formula.value.upper()
        return f"textbook {name}" if self.is_textbook else f"polmvs {name}"


class Light(StrEnum):
    """Which reflection dominates the polarization of the part."""

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
