"""The record of a run, and the tables and pages made from it."""
