"""Virtual patients: cases that hide their truth."""
