"""FEBio: its input file, elements and materials."""
