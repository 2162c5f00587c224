"""The anatomy as value objects: leaflets, chordae, motion, and the parametric template."""
