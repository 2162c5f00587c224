"""From a valve in images to a case, its measures, and files for other software.

The frames pass the same checks and derivations as those of a case folder. Fibres run around the
valve, and chordae are laid out as in the template. Coordinates stay those of the images (LPS).
"""
