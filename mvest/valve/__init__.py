"""What the anatomy is: leaflets, annulus, chordae, papillary muscles, and their meshes."""
