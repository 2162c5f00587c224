"""Bodies and valves as input of FEBio (file format 4), and what FEBio makes of them.

FEBio (febio.org, MIT licence) is a finite-element program for soft tissue that others keep. Nothing
of it is needed to write its input; to run it, name the program (`mvest.febio.program`).
"""
