"""From a valve in images to a case, and to the measures and files that users of images expect.

The frames of a sequence are taken as those of a case folder would be, with the same checks and the
same derivations: fibres run around the valve, and chordae are laid out as in the template, as long
as the closed frame asks for. Coordinates stay those of the images (LPS).
"""
