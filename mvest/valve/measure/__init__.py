"""Measures of a valve: annulus, orifice, coaptation, tenting, gaps and leaks."""
