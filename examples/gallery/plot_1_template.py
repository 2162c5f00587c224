"""
A valve and its measures
========================

The template is a smooth surface in material coordinates, so every resolution shows the same valve.
Its parameters are lengths in mm; other values give another anatomy.
"""

import matplotlib.pyplot as plt
from drawing import draw, same_scale

import mvest
from mvest.reporting.figures import ATRIUM, SIDE
from mvest.valve.anatomy.dimensions import (
    AnnulusDimensions,
    LeafletDimensions,
    LeafletPair,
)
from mvest.valve.measure.clinical import clinical_measurements

posterior = LeafletDimensions(length=18.0, thickness=1.26, belly=0.07)
anatomies = {
    "template": mvest.TemplateParameters(),
    "wide annulus": mvest.TemplateParameters(annulus=AnnulusDimensions(41.0, 30.0)),
    "long posterior leaflet": mvest.TemplateParameters(leaflets=LeafletPair(posterior=posterior)),
}
drawn = []
figure, panels = plt.subplots(2, 3, figsize=(9, 6.2), layout="constrained")
for (title, parameters), (above, beside) in zip(anatomies.items(), panels.T, strict=True):
    valve = mvest.Template(parameters).valve(56, 15)
    x, ring = valve.surface.vertices, valve.surface.vertices[valve.annulus]
    found = clinical_measurements(x, valve.surface, ring, valve.papillary_tips, 1.9)
    drawn += [x, valve.papillary_tips]
    draw(above, valve, view=ATRIUM)
    draw(beside, valve, view=SIDE, chords=True)
    size = f"AP {found['ap_diameter_mm']:.0f} mm, orifice {found['orifice_mm2']:.0f} mm²"
    above.set_title(f"{title}\n{size}", fontsize=10)
    for name in ("ap_diameter_mm", "commissural_diameter_mm", "posterior_length_mm"):
        print(f"{title:22} {name:24} {found[name]:5.1f}")
same_scale(panels[0], drawn[::2], ATRIUM)
same_scale(panels[1], drawn, SIDE)

# %%
# Above: seen from the atrium, the anterior leaflet on top. Below: from the side, with the chordae
# from the two papillary tips. The second valve has a wider annulus, the third a longer posterior
# leaflet, which leaves a smaller orifice.
