"""How many closed frames, and how well known pressures, it takes to know the moduli."""
