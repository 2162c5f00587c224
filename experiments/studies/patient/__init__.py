"""Virtual patients: the study, and its figures."""
