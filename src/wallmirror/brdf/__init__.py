"""Reflectance models of section 1.2, tables of them, and audits of their physics.

=================  ==================================================================  ===========
model              in the plane                                                        angle sum
=================  ==================================================================  ===========
Diffuse            albedo / pi (eq. 1.12)                                              yes
Mirror             delta(u) (eqs. 1.11, 2.14)                                          yes
Phong              c cos(u)^n, energy-conserving or plain                              yes
Blinn              c cos(u/2)^n, energy-conserving or plain                            yes
GaussianTrain      Gaussian lobes in u (eq. 2.15, rho_test)                            yes
CookTorrance       F D G over cosines; GGX or Beckmann; grooves or isotropic           no
PhongIllumination  c cos(u)^n / cos(theta_s), Phong's formula of 1975; for audits      no
AngleSumTable      linear between nodes of u                                           yes
Table              bilinear between nodes of both angles                               no
Sum, GeneralSum    sums of models                                                      yes, no
=================  ==================================================================  ===========

u = theta_s + theta_o; all are constant along z (see `base`).
"""

from wallmirror.brdf.audits import Audit, Finding, audit
from wallmirror.brdf.base import BRDF, AngleSumBRDF, LobeForm
from wallmirror.brdf.energy import directional_albedo, directional_albedos
from wallmirror.brdf.ideal import Diffuse, Mirror
from wallmirror.brdf.lobes import Blinn, GaussianTrain, LobeHeight, Phong, PhongIllumination
from wallmirror.brdf.microfacet import CookTorrance, FacetDistribution, Facets, Fresnel, Schlick
from wallmirror.brdf.sums import GeneralSum, Sum
from wallmirror.brdf.tables import AngleSumTable, Table, Tabulated, tabulate, tabulate_to

__all__ = [
    "BRDF",
    "AngleSumBRDF",
    "AngleSumTable",
    "Audit",
    "Blinn",
    "CookTorrance",
    "Diffuse",
    "FacetDistribution",
    "Facets",
    "Finding",
    "Fresnel",
    "GaussianTrain",
    "GeneralSum",
    "LobeForm",
    "LobeHeight",
    "Mirror",
    "Phong",
    "PhongIllumination",
    "Schlick",
    "Sum",
    "Table",
    "Tabulated",
    "audit",
    "directional_albedo",
    "directional_albedos",
    "tabulate",
    "tabulate_to",
]
