"""Simulated transoesophageal echo volumes of a moving valve, for training and testing detectors."""
