"""What acts on the tissue from outside: pressure, chordae, the hinge, contact, clips."""
