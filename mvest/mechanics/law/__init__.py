"""Laws of leaflet tissue: moduli in, energy, stress and tangent out."""
