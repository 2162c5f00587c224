"""What moduli come from surfaces as other programs and segmentations bring them."""
