"""A small valve under which predictions take seconds."""

from mvest.closure.model import ClosureModel
from mvest.mechanics.settings import ClosureProtocol, MechanicsSettings, TissueSettings
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

TISSUE = {"anterior": TissueSettings(2.651), "posterior": TissueSettings(1.106)}
NAMES = ("E_f.anterior", "E_f.posterior")


def model(cells=(12, 2), observed=(24, 7), contact=(48, 9), **protocol):
    """The default anatomy, which closes."""
    template = Template()
    settings = MechanicsSettings(tissue=TISSUE, protocol=ClosureProtocol(**protocol))
    return ClosureModel(
        template.valve(*observed),
        template.valve(*contact),
        structured_mesh(template, "hex18", *cells),
        settings,
        NAMES,
        continuation=True,
    )
