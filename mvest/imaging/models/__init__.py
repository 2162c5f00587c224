"""Trained detectors that come with the package."""

from pathlib import Path

__all__ = ["MODEL_FILE"]

MODEL_FILE = Path(__file__).resolve().with_name("tee.npz")
"""Those for transoesophageal echo, as `mvest.imaging.detection.trained_model` reads them."""
