"""Bodies and valves as input of FEBio (file format 4), and where it moves their nodes.

FEBio (febio.org, MIT licence) is a finite-element program for soft tissue that others keep. Nothing
of it is needed to write its input.
"""
