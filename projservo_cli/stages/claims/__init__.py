"""What the paper claims about its method and what the runs say; no verdict is fixed beforehand."""

from projservo_cli.figures.material import Material
from projservo_cli.records import FloatArray
from projservo_cli.stages.claims.claim import Claim
from projservo_cli.stages.claims.control import control_claims
from projservo_cli.stages.claims.drift import composition_claim, drift_claims
from projservo_cli.stages.claims.images import classical, direct, planned

__all__ = ["Claim", "claims_of"]


def claims_of(material: Material, eq22: tuple[FloatArray, FloatArray] | None) -> list[Claim]:
    """All claims that this run can speak about, in the order of the paper.

    Parameters
    ----------
    material : records, truth and extra runs.
    eq22 : shares λ, and the distances of the centre between both sides of (22), m; None where they
        could not be computed.
    """
    found = [*classical(material), *planned(material), *direct(material)]
    if material.studies is not None:
        found += [*drift_claims(material, material.studies), *control_claims(material, material.studies)]
    if eq22 is not None:
        found.append(composition_claim(*eq22))
    return found
