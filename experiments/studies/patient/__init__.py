"""The study of virtual patients, and its figures."""
